"""Cameras, Gaussians, footprints, models and views for tests: one place, plain defaults, seeded."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from torch import Tensor

from kgs import DropGaussian, GaussianModel, Gaussians, PosedCamera, ProjectedGaussians, RasterOptions
from kgs.datasets import Views

FIELDS = ("means", "quats", "scales", "opacities", "colors")
OUTPUTS = ("image", "alpha", "depth", "median_depth")
LENS_PARAMS = {  # of a picture of 48 x 64 pixels, off centre
    CameraModelType.PINHOLE: (50.0, 55.0, 30.0, 25.0),
    CameraModelType.BROWN_CONRADY: (50.0, 55.0, 30.0, 25.0, 0.1, -0.05, 0.003, -0.002, 0.01, 0.02, 0.03, 0.01),
    CameraModelType.KANNALA_BRANDT_K3: (50.0, 55.0, 30.0, 25.0, 0.1, -0.05, 0.003, -0.002),
    CameraModelType.ORTHOGRAPHIC: (10.0, 11.0, 30.0, 25.0),
}


# -- cameras -------------------------------------------------------------------------------------------------------


def pinhole(
    height: int,
    width: int,
    focal: float | tuple[float, float],
    centre: tuple[float, float] | None = None,
    skew: float = 0.0,
    extrinsics: Tensor | None = None,
    dtype: torch.dtype = torch.float64,
    cameras: int = 1,
) -> PinholeCamera:
    """Equal cameras; centred and at the origin unless told otherwise."""
    fx, fy = focal if isinstance(focal, tuple) else (focal, focal)
    cx, cy = ((width - 1) / 2, (height - 1) / 2) if centre is None else centre
    intrinsics = torch.eye(4, dtype=torch.float64)
    intrinsics[:2, :3] = torch.tensor([[fx, skew, cx], [0.0, fy, cy]], dtype=torch.float64)
    extrinsics = torch.eye(4, dtype=dtype) if extrinsics is None else extrinsics
    size = (torch.full((cameras,), value) for value in (height, width))
    return PinholeCamera(*(part.to(dtype).repeat(cameras, 1, 1) for part in (intrinsics, extrinsics)), *size)


def random_camera(height: int, width: int, seed: int, dtype: torch.dtype = torch.float64) -> PinholeCamera:
    """A slightly turned and shifted camera with an off-centre principal point, about 50 degrees wide."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(10, generator=generator, dtype=torch.float64) * 2 - 1
    twist = 0.1 * draw[:3]
    generators = torch.linalg.cross(torch.eye(3, dtype=torch.float64), twist.expand(3, 3))
    extrinsics = torch.eye(4, dtype=torch.float64)
    extrinsics[:3, :3] = torch.linalg.matrix_exp(generators)
    extrinsics[:3, 3] = 0.1 * draw[3:6]
    fx, fy = (max(height, width) * (1 + 0.05 * draw[6:8])).tolist()
    cx, cy = float((width - 1) / 2 + 0.1 * width * draw[8]), float((height - 1) / 2 + 0.1 * height * draw[9])
    return pinhole(height, width, (fx, fy), (cx, cy), 0.0, extrinsics, dtype)


def batch(*cameras: PinholeCamera) -> PinholeCamera:
    """One batch of all of them."""
    parts = ("intrinsics", "extrinsics", "height", "width")
    return PinholeCamera(*(torch.cat([getattr(camera, part) for camera in cameras]) for part in parts))


def staged(**given: Any) -> dict[str, Any]:
    """Arguments of `project` and `composite`: the fields of `RasterOptions` among these, gathered into one."""
    fields = {field.name for field in dataclasses.fields(RasterOptions)}
    options = RasterOptions(**{name: value for name, value in given.items() if name in fields})
    return {"options": options} | {name: value for name, value in given.items() if name not in fields}


def whole_matrices(rows: Tensor) -> Tensor:
    """Intrinsics `(C, 4, 4)` of their first two rows `(C, 2, 3)`, the only ones that are free."""
    full = torch.eye(4, dtype=rows.dtype).repeat(len(rows), 1, 1)
    full[:, :2, :3] = rows
    return full


def with_camera(
    camera: PinholeCamera, extrinsics: Tensor | None = None, intrinsics: Tensor | None = None
) -> PinholeCamera:
    """The camera with another pose or other intrinsics, `(4, 4)` or `(C, 4, 4)`."""
    intrinsics = camera.intrinsics if intrinsics is None else intrinsics
    extrinsics = camera.extrinsics if extrinsics is None else extrinsics
    k, pose = (part.to(camera.intrinsics).reshape(-1, 4, 4) for part in (intrinsics, extrinsics))
    return PinholeCamera(k, pose, camera.height, camera.width)


def posed(
    kind: CameraModelType,
    params: Sequence[float] | Tensor | None = None,
    size: tuple[int, int] = (48, 64),
    dtype: torch.dtype = torch.float64,
    extrinsics: Tensor | None = None,
    cameras: int = 1,
) -> PosedCamera:
    """A camera model of the given kind, by default with `LENS_PARAMS` and at the origin; `size` is (height, width)."""
    params = LENS_PARAMS[kind] if params is None else params
    params = params if isinstance(params, Tensor) else torch.tensor(params, dtype=dtype)
    extrinsics = torch.eye(4, dtype=dtype).repeat(cameras, 1, 1) if extrinsics is None else extrinsics
    return PosedCamera(CameraModel(ImageSize(*size), kind, params), extrinsics)


def looking_at(target: Tensor, centers: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrices `(V, 4, 4)`, float64, of upright cameras with these centres."""
    centers = centers.double()
    ahead = torch.nn.functional.normalize(target.double() - centers, dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(ahead, up.double().expand_as(ahead)), dim=1)
    poses = torch.eye(4).double().repeat(len(centers), 1, 1)
    poses[:, :3, :3] = torch.stack([right, torch.linalg.cross(ahead, right), ahead], 1)
    poses[:, :3, 3] = -(poses[:, :3, :3] @ centers[:, :, None])[:, :, 0]
    return poses


# -- Gaussians -----------------------------------------------------------------------------------------------------


def as_model(gaussians: Gaussians) -> GaussianModel:
    """A model of Gaussians that have harmonics."""
    return GaussianModel(
        gaussians.means,
        gaussians.quats,
        gaussians.scales.log(),
        gaussians.opacities.logit(),
        gaussians.colors[:, :1],
        gaussians.colors[:, 1:],
    )


def random_gaussians(
    n: int,
    seed: int,
    dtype: torch.dtype = torch.float64,
    sh_degree: int | None = 0,
    image_size: int = 64,
    opacities: tuple[float, float] = (0.05, 0.95),
) -> Gaussians:
    """An ordinary scene in front of `random_camera`: z in 2 to 6, anisotropic footprints of 1 to 6 px.

    Drawn in float64 and then rounded to `dtype`.

    Args:
        n: how many.
        seed: of a generator of its own.
        dtype: of the result.
        sh_degree: degree of the harmonics, or None for RGB.
        image_size: larger side of the image in pixels, to which the footprints refer.
        opacities: range of the uniform opacities.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    z = uniform(2, 6, n, 1)
    means = torch.cat([uniform(-0.6, 0.6, n, 2) * z, z], 1)
    quats = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    scales = uniform(1, 6, n, 3) * z / image_size
    opacity = uniform(*opacities, n)
    if sh_degree is None:
        colors = uniform(0, 1, n, 3)
    else:
        colors = 0.3 * torch.randn(n, (sh_degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    return Gaussians(*(value.to(dtype) for value in (means, quats, scales, opacity, colors)))


def random_scene(
    seed: int,
    dtype: torch.dtype = torch.float64,
    n: int = 150,
    size: tuple[int, int] = (40, 56),
    sh_degree: int | None = 2,
    cameras: int = 1,
) -> tuple[Gaussians, PinholeCamera]:
    """Random Gaussians and a batch of random cameras; `size` is (height, width)."""
    views = [random_camera(*size, seed + i, dtype) for i in range(cameras)]
    return random_gaussians(n, seed, dtype, sh_degree, max(size)), batch(*views)


def one_gaussian(
    scales: Sequence[float],
    quat: Sequence[float] = (0.9, 0.2, -0.3, 0.4),
    mean: Sequence[float] = (0.05, -0.03, 4.0),
    opacity: float = 0.8,
    color: Sequence[float] = (0.3, 0.6, 0.9),
    dtype: torch.dtype = torch.float64,
) -> Gaussians:
    """A single Gaussian with an RGB colour."""
    values: list[Any] = [[mean], [quat], [scales], [opacity], [color]]
    return Gaussians(*(torch.tensor(value, dtype=torch.float64).to(dtype) for value in values))


def leaves(gaussians: Gaussians) -> tuple[Gaussians, list[Tensor]]:
    """The same Gaussians with leaves that want gradients, and these in the order of `FIELDS`."""
    inputs = [getattr(gaussians, name).detach().clone().requires_grad_() for name in FIELDS]
    return Gaussians(*inputs), inputs


def replace(gaussians: Gaussians, **changes: Tensor) -> Gaussians:
    """The Gaussians with some fields replaced."""
    return Gaussians(**{name: getattr(gaussians, name) for name in FIELDS} | changes)


def select(gaussians: Gaussians, ids: Tensor) -> Gaussians:
    """The Gaussians with the given numbers, in that order."""
    rows = {name: getattr(gaussians, name)[ids] for name in FIELDS if name != "opacities"}
    return Gaussians(opacities=gaussians.opacities[..., ids], **rows)


def join(*parts: Gaussians) -> Gaussians:
    """All Gaussians of all parts."""
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in FIELDS))


# -- footprints ----------------------------------------------------------------------------------------------------


def footprints(
    means2d: Tensor, factors: Tensor, opacities: Tensor, size: tuple[int, int], eps2d: float = 0.3, **changes: Any
) -> ProjectedGaussians:
    """Hand-made footprints of one camera, front to back: what `project` would have returned.

    Args:
        means2d: `(M, 2)`, pixels.
        factors: `(M, 2, 3)`, pixels; the covariance is `factors @ factors.mT + eps2d I`.
        opacities: `(M,)`.
        size: (height, width) of the image.
        eps2d: px^2.
        changes: other fields of `ProjectedGaussians`, such as depths, camera_ids, num_cameras, colors.
    """
    m = len(means2d)
    made = ProjectedGaussians(
        camera_ids=torch.zeros(m, dtype=torch.int64),
        gaussian_ids=torch.arange(m),
        means2d=means2d,
        factors=factors,
        depths=torch.arange(1, m + 1).to(means2d),
        radii=torch.ones(m).to(means2d),
        opacities=opacities,
        colors=torch.zeros(m, 3).to(means2d),
        image_size=size,
        num_cameras=1,
        num_gaussians=m,
        num_nonfinite=torch.tensor(0),
        eps2d=eps2d,
    )
    return dataclasses.replace(made, **changes)


# -- the layer -----------------------------------------------------------------------------------------------------


def random_opacities(n: int = 1000, dtype: torch.dtype = torch.float32, seed: int = 0) -> Tensor:
    """Uniform in [0, 1)."""
    return torch.rand(n, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def drop_layer(progress: float, **options: Any) -> DropGaussian:
    """The layer at some progress, in `train()`."""
    layer = DropGaussian(**options)
    layer.progress = progress
    return layer


# -- other people's programs ---------------------------------------------------------------------------------------


@contextlib.contextmanager
def other_defaults(dtype: torch.dtype = torch.float64, device: str | None = "meta") -> Iterator[None]:
    """Torch's default device is "meta", which stands for an accelerator, and its default dtype another."""
    torch.set_default_device(device)
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_device(None)  # "cpu" would leave a mode behind, which changes how graphs are traced
        torch.set_default_dtype(torch.float32)


# -- models and views ----------------------------------------------------------------------------------------------


def random_cloud(n: int = 200, seed: int = 0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Points and their colours."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 3, generator=generator, dtype=dtype)
    return points, torch.rand(n, 3, generator=generator, dtype=dtype)


def random_model(n: int = 7, sh_degree: int = 3, dtype: torch.dtype = torch.float32, seed: int = 0) -> GaussianModel:
    """A model whose parameters are all normal numbers."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh_dc": (n, 1, 3)}
    shapes["sh_rest"] = (n, (sh_degree + 1) ** 2 - 1, 3)
    return GaussianModel(**{k: torch.randn(v, generator=generator, dtype=dtype) for k, v in shapes.items()})


def random_views(count: int = 2, height: int = 18, width: int = 23, seed: int = 0) -> Views:
    """Noise for pictures, of cameras that stand at -0, -1, -2, ... along x."""
    images = torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(seed))
    cameras = pinhole(height, width, float(width), dtype=torch.float32, cameras=count)
    extrinsics = cameras.extrinsics.clone()
    extrinsics[:, 0, 3] = torch.arange(count)
    return Views(with_camera(cameras, extrinsics), images, tuple(f"{i}.png" for i in range(count)))


def splat_columns(degree: int = 0) -> list[str]:
    """The properties of a vertex as the files of 3D Gaussian Splatting name and order them."""
    rest = [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest]
    return [*names, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
