"""What a program allows torch to round does not reach a render: no operator is called that torch would round."""

import pytest
import torch
from factories import leaves, random_camera, random_gaussians
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from operators import Operators

from kgs import GaussianRenderer, PosedCamera, backends

OUTPUTS = ("image", "alpha", "depth", "median_depth", "normal")
PRODUCTS = {"mm", "bmm", "addmm", "addbmm", "baddbmm", "mv", "addmv", "dot", "vdot", "matmul", "linear", "einsum"}
LENSES = {
    "brown": (CameraModelType.BROWN_CONRADY, (-0.1, 0.02, 0.001, -0.001, 0.0, 0.0, 0.0, 0.0)),
    "fisheye": (CameraModelType.KANNALA_BRANDT_K3, (0.02, -0.005, 0.001, 0.0)),
    "orthographic": (CameraModelType.ORTHOGRAPHIC, ()),
}


def camera_of(kind):
    camera = random_camera(24, 32, 0, torch.float32)
    if kind == "sheared":  # no rotation: its inverse is not its transpose
        camera.extrinsics[0, 0, 1] += 0.3
    if kind not in LENSES:
        return camera
    model, extra = LENSES[kind]
    k = camera.intrinsics[0]
    params = torch.stack([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *torch.tensor(extra)])
    return PosedCamera(CameraModel(ImageSize(24, 32), model, params), camera.extrinsics.clone())


@pytest.fixture
def torch_alone(monkeypatch):
    monkeypatch.setattr(backends, "BACKENDS", {"torch": backends.BACKENDS["torch"]})


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize("kind", ["pinhole", "sheared", *LENSES])
def test_no_product_of_matrices_is_taken(kind):
    gaussians, inputs = leaves(random_gaussians(200, 0, torch.float32, 3))
    camera = camera_of(kind)
    lens = camera.model.params if kind in LENSES else camera.intrinsics
    inputs += [camera.extrinsics.requires_grad_(), lens.requires_grad_()]
    with Operators() as operators:
        out = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
        (out.image.square().sum() + out.depth.mean() + out.normal.sum()).backward()
    assert {"exp", "exp_"} & set(operators.names)
    assert not PRODUCTS & set(operators.names)
    assert all(x.grad.isfinite().all() and x.grad.any() for x in inputs)
