"""Kornia's camera models, for lenses that a pinhole camera cannot describe.

The only file that imports `kornia.sensors`, which is in no tier of Kornia's stability policy.
"""

from kornia.geometry.vector import Vector3
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from kornia.sensors.camera.distortion_model import AffineTransform, BrownConradyTransform
from kornia.sensors.camera.projection_model import OrthographicProjection
from torch import Tensor

__all__ = ["CameraModel", "camera_model", "lens_of", "project"]

_TYPES = {
    "pinhole": CameraModelType.PINHOLE,
    "orthographic": CameraModelType.ORTHOGRAPHIC,
    "brown_conrady": CameraModelType.BROWN_CONRADY,
    "kannala_brandt": CameraModelType.KANNALA_BRANDT_K3,
}


def camera_model(lens: str, params: Tensor, size: tuple[int, int]) -> CameraModel:
    """Kornia's model of a lens that `lens_of` names; `params` are `(P,)` or `(C, P)`, `size` is (height, width)."""
    return CameraModel(ImageSize(*size), _TYPES[lens], params)


def lens_of(model: CameraModel) -> str:
    """The lens of a model: "pinhole", "orthographic", "brown_conrady" or "kannala_brandt"."""
    if isinstance(model.projection, OrthographicProjection):
        return "orthographic"
    if isinstance(model.distortion, AffineTransform):
        return "pinhole"
    return "brown_conrady" if isinstance(model.distortion, BrownConradyTransform) else "kannala_brandt"


def project(model: CameraModel, params: Tensor, points: Tensor) -> Tensor:
    """Pixels `(M, 2)` of points in the camera's frame `(M, 3)`, by a model with the parameters `(P,)` of one camera."""
    pixels: Tensor = model.distortion.distort(params, model.projection.project(Vector3(points))).data
    return pixels
