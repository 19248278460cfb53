"""Scenes, fits and the reference under both default dtypes of torch: the same dtypes, and the same numbers.

Those of the model, the layer, the renderer, the densifier, the loss and PLY files are in their own tests, which set
another default device too.
"""

import dataclasses
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

import kgs
import kgs.reference
from kgs.datasets import Scene, synthetic
from kgs.fit import FitConfig, Trainer, initial_points, make_plan

SIZE = (24, 32)


def model(degree: int = 1) -> kgs.GaussianModel:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(30, 3, generator=generator, dtype=torch.float32) + torch.tensor((-0.5, -0.5, 2.0)).float()
    return kgs.GaussianModel.from_points(points, torch.rand(30, 3, generator=generator, dtype=torch.float32), degree)


def camera() -> PinholeCamera:
    k = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]], dtype=torch.float32)
    return kgs.pinhole_cameras(torch.eye(4, dtype=torch.float32), k, SIZE[1], SIZE[0], "half")


def made_scene(new: bool = False) -> Scene:
    if new:
        synthetic._make_world.cache_clear()
    return synthetic.synthetic_scene(train_views=3, test_views=1, size=(32, 40))


def points_of_a_file() -> object:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cloud.ply")
        trimesh.PointCloud(np.random.default_rng(0).random((20, 3))).export(path)
        return initial_points(made_scene().train, "file", file=path)


def trained() -> object:
    scene = made_scene()
    plan = make_plan(scene, FitConfig(steps=2, drop=0.3))
    trainer = Trainer(scene, plan, initial_points(scene.train, "random", count=50))
    for _ in range(2):
        trainer.train_step()
    return trainer.model.state_dict()


FACTORIES: dict[str, Callable[[], object]] = {
    "pinhole_cameras": lambda: [camera().intrinsics, camera().extrinsics],
    "reference": lambda: kgs.reference.render(model()(), camera()),
    "camera_extent": lambda: torch.tensor(kgs.camera_extent(camera().extrinsics), dtype=torch.float64),
    "initial_points random": lambda: initial_points(made_scene().train, "random", count=50),
    "initial_points sift": lambda: initial_points(made_scene().train, "sift", count=50),
    "initial_points file": points_of_a_file,
    "Trainer": trained,
}


@pytest.fixture
def under() -> Iterator[Callable[[torch.dtype], None]]:
    """Sets torch's default dtype."""
    yield torch.set_default_dtype
    torch.set_default_dtype(torch.float32)


def tensors(value: object) -> Iterator[Tensor]:
    """All tensors in a value, however deep."""
    if isinstance(value, Tensor):
        yield value.detach()
    elif isinstance(value, PinholeCamera):
        yield from tensors([value.intrinsics, value.extrinsics])
    elif dataclasses.is_dataclass(value):
        yield from tensors(list(vars(value).values()))
    elif isinstance(value, dict):
        yield from tensors(list(value.values()))
    elif isinstance(value, list | tuple):
        for part in value:
            yield from tensors(part)


@pytest.mark.parametrize("name", FACTORIES)
def test_the_default_dtype_changes_nothing(name, under):
    made = []
    for dtype in (torch.float32, torch.float64):
        under(dtype)
        made.append(list(tensors(FACTORIES[name]())))
    expected, got = made
    assert expected
    assert [x.dtype for x in got] == [x.dtype for x in expected]
    assert all(torch.equal(a, b) for a, b in zip(got, expected, strict=True))


def test_a_scene_is_the_same_and_no_texture_keeps_the_default_dtype_it_was_made_under(under):
    under(torch.float64)
    double = made_scene(new=True)
    under(torch.float32)
    cached = made_scene()
    expected = made_scene(new=True)
    assert expected.train.images.dtype == torch.float32
    for scene in (double, cached):
        pairs = list(zip(tensors(scene), tensors(expected), strict=True))
        assert all(a.dtype == b.dtype and torch.equal(a, b) for a, b in pairs)
