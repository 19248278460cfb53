"""Whatever dtype torch makes tensors of by default, and on which device: results are the same, to the bit.

The loss is in its own tests.
"""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from densifiers import LARGE, seen
from densifiers import densifier as make_densifier
from factories import (
    FIELDS,
    OUTPUTS,
    drop_layer,
    leaves,
    other_defaults,
    posed,
    random_cloud,
    random_model,
    random_opacities,
    random_scene,
    random_views,
)
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType
from tiny_scenes import write_blender, write_colmap, write_llff, write_nerfstudio
from torch import Tensor

import kgs
import kgs.reference
from kgs.backends import BACKENDS
from kgs.datasets import Scene, load_scene, synthetic
from kgs.fit import FitConfig, Trainer, initial_points, make_plan
from kgs.init_points.plane_sweep import sweep_depths

GAUSSIANS, CAMERA = random_scene(0, torch.float32, 60, (24, 32), 3)
FISHEYE = posed(CameraModelType.KANNALA_BRANDT_K3, dtype=torch.float32)
LENS = CAMERA.intrinsics[:, :3, :3].clone()
POINTS, COLORS = random_cloud()
OPACITIES = random_opacities()
MODEL, VIEWS = random_model(), random_views()
ORIGIN = torch.ones(3)
WRITERS = (write_llff, write_colmap, write_blender, write_nerfstudio)


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


def loaded_model() -> object:
    model = kgs.GaussianModel.from_points(POINTS, COLORS)
    model.load_state_dict(model.state_dict())
    return [*model.state_dict().values(), *vars(model()).values()]


def dropped(seed: int | None) -> Tensor:
    torch.manual_seed(0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        return drop_layer(1.0, p=0.5, seed=seed)(OPACITIES)


def densified(model: kgs.GaussianModel, optimizer: torch.optim.Optimizer, densifier: kgs.Densifier) -> object:
    torch.manual_seed(0)
    model, optimizer, densifier = copy.deepcopy((model, optimizer, densifier))
    densifier.step()
    densifier.reset_opacity(0.9)
    kgs.Densifier(model, optimizer, 1.0)
    return model.state_dict()


def saved(path: Path) -> object:
    kgs.save_ply(path, MODEL, ORIGIN)
    return [kgs.load_ply(path, origin=ORIGIN).state_dict(), torch.from_numpy(np.fromfile(path, np.uint8))]


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
        yield from (value.intrinsics, value.extrinsics, value.height, value.width)
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


def test_all_that_makes_tensors_makes_the_same_under_other_defaults(scene, points, tmp_path):
    trimesh.PointCloud(points.points.numpy()).export(tmp_path / "cloud.ply")
    for write in WRITERS:
        (tmp_path / write.__name__).mkdir()
        write(tmp_path / write.__name__)
    model, optimizer, densifier = make_densifier([LARGE] * 3)
    densifier.observe(seen(model, [0, 1], [(1, 0), (1, 0)]))
    makers = {
        "reference": lambda: kgs.reference.render(GAUSSIANS, CAMERA),
        "random": lambda: initial_points(scene.train, "random", count=50),
        "sift": lambda: initial_points(scene.train, "sift", count=50),
        "file": lambda: initial_points(scene.train, "file", file=tmp_path / "cloud.ply"),
        "Trainer": lambda: trained(scene, points),
        "model": loaded_model,
        "layer": lambda: [dropped(None), dropped(3)],
        "densifier": lambda: densified(model, optimizer, densifier),
        "splat": lambda: saved(tmp_path / "splat.ply"),
        "sweep": lambda: [sweep_depths(VIEWS, 2.0, 20.0, backend=name) for name in BACKENDS if name != "triton"],
        "scenes": lambda: [load_scene(tmp_path / write.__name__, downscale=2) for write in WRITERS],
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
