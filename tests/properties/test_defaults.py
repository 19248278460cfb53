"""Whatever dtype torch makes tensors of by default, and on which device: results are the same, to the bit.

Models, the layer, the densifier, the loss and PLY files are in their own tests.
"""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import pytest
import torch
import trimesh
from factories import FIELDS, OUTPUTS, leaves, other_defaults, posed, random_scene
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType
from torch import Tensor

import kgs
import kgs.reference
from kgs.datasets import Scene, synthetic
from kgs.fit import FitConfig, Trainer, initial_points, make_plan

GAUSSIANS, CAMERA = random_scene(0, torch.float32, 60, (24, 32), 3)
FISHEYE = posed(CameraModelType.KANNALA_BRANDT_K3, dtype=torch.float32)
LENS = CAMERA.intrinsics[:, :3, :3].clone()


def made_scene(new: bool = False) -> Scene:
    if new:
        synthetic._make_world.cache_clear()
    return synthetic.synthetic_scene(train_views=3, test_views=1, size=(32, 40))


def rendered(camera: kgs.PosedCamera | PinholeCamera) -> object:
    gaussians, inputs = leaves(GAUSSIANS)
    out = kgs.GaussianRenderer()(gaussians, camera, outputs=(*OUTPUTS, "normal"))
    out.image.square().sum().backward()
    return [*(getattr(out, name) for name in (*OUTPUTS, "normal")), *(x.grad for x in inputs)]


def rasterized() -> object:
    options = {"width": 32, "height": 24, "sh_degree": 3, "render_mode": "RGB+ED"}
    values = [getattr(GAUSSIANS, name) for name in FIELDS]
    return kgs.rasterization(*values, CAMERA.extrinsics, LENS, **options)[:2]


def trained(scene: Scene, points: kgs.fit.InitialPoints) -> object:
    trainer = Trainer(scene, make_plan(scene, FitConfig(steps=2, drop=0.3), points), points)
    for _ in range(2):
        trainer.train_step()
    return trainer.model.state_dict()


def assert_unchanged(make: Callable[[], object], others: AbstractContextManager[None]) -> None:
    expected = list(tensors(make()))
    with others:
        got = list(tensors(make()))
    assert expected
    for a, b in zip(got, expected, strict=True):
        assert (a.dtype, a.device) == (b.dtype, b.device)
        assert torch.equal(a, b)


def tensors(value: object) -> Iterator[Tensor]:
    """All tensors in a value, however deep."""
    if isinstance(value, Tensor):
        yield value.detach()
    elif isinstance(value, PinholeCamera):
        yield from (value.intrinsics, value.extrinsics)
    elif dataclasses.is_dataclass(value):
        yield from tensors(vars(value))
    elif isinstance(value, dict):
        yield from tensors(list(value.values()))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from tensors(part)


RENDERS = {
    "renderer": lambda: rendered(CAMERA),
    "renderer, fisheye": lambda: rendered(FISHEYE),
    "rasterization": rasterized,
    "pinhole_cameras": lambda: kgs.pinhole_cameras(CAMERA.extrinsics, LENS, 32, 24, "half"),
    "camera_extent": lambda: torch.tensor(kgs.camera_extent(CAMERA.extrinsics), dtype=torch.float64, device="cpu"),
}


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("name", RENDERS)
def test_renders_are_on_the_device_and_in_the_dtype_of_their_inputs(name):
    assert_unchanged(RENDERS[name], other_defaults())


def test_the_reference_scenes_and_fits_are_the_same_under_other_defaults(scene, points, tmp_path):
    trimesh.PointCloud(points.points.numpy()).export(tmp_path / "cloud.ply")
    makers = {
        "reference": lambda: kgs.reference.render(GAUSSIANS, CAMERA),
        "random": lambda: initial_points(scene.train, "random", count=50),
        "sift": lambda: initial_points(scene.train, "sift", count=50),
        "file": lambda: initial_points(scene.train, "file", file=tmp_path / "cloud.ply"),
        "Trainer": lambda: trained(scene, points),
    }
    for make in makers.values():
        assert_unchanged(make, other_defaults())


def test_a_scene_keeps_no_texture_of_the_defaults_it_was_made_under():
    with other_defaults(device=None):
        double = made_scene(new=True)
    cached = made_scene()
    expected = made_scene(new=True)
    assert expected.train.images.dtype == torch.float32
    for scene in (double, cached):
        pairs = list(zip(tensors(scene), tensors(expected), strict=True))
        assert all(a.dtype == b.dtype and torch.equal(a, b) for a, b in pairs)
