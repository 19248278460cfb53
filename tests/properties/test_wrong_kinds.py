"""Something of a near kind as an argument: a model for its Gaussians, a list for a tensor, text for a path.

What is meant is taken, and what is wrong is an error that names the argument, not one from inside torch.
"""

import functools

import numpy as np
import pytest
import torch
from factories import random_gaussians, random_model, random_views
from tiny_scenes import write_colmap

import kgs
from kgs import reference
from kgs.app.files.film import write_film
from kgs.app.files.glb import save_glb
from kgs.datasets import Views, load_scene, synthetic_scene
from kgs.densify import Densifier
from kgs.fit import FitConfig, InitialPoints, Trainer, fit_scene, initial_points
from kgs.fit.plan import make_plan
from kgs.geometry.rigs import camera_extent
from kgs.losses import photometric_loss

UPRIGHT = torch.eye(3)
CONFIG = FitConfig(steps=2, evaluations=1, init="random", init_points=50, backend="torch")


@functools.cache
def scene():
    return synthetic_scene(train_views=2, test_views=1, size=(16, 16))


@functools.cache
def points():
    return initial_points(scene().train, "random", count=30)


def rasterize(**changes):
    gaussians = random_gaussians(4, 0, torch.float32)
    matrix = torch.tensor([[[9.0, 0.0, 8.0], [0.0, 9.0, 8.0], [0.0, 0.0, 1.0]]])
    arguments = {name: getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities")}
    arguments |= {"colors": torch.rand(4, 3), "viewmats": torch.eye(4)[None], "Ks": matrix, "width": 16, "height": 16}
    return kgs.rasterization(**arguments | changes)


def views(images, names=("a", "b")):
    return Views(scene().train.cameras, images, names)


MODEL, PHOTO = random_model(5), torch.rand(1, 3, 16, 16)
WRONG = [
    ("gaussians", TypeError, lambda: reference.render(MODEL, scene().train.camera(0))),
    ("model", TypeError, lambda: save_glb("x.glb", MODEL(), UPRIGHT)),
    ("model", TypeError, lambda: Densifier(MODEL(), None, 1.0)),
    ("projected", TypeError, lambda: Densifier(MODEL, torch.optim.Adam(MODEL.parameters()), 1.0).observe(MODEL())),
    ("index", TypeError, lambda: MODEL()[0]),
    ("backgrounds", TypeError, lambda: rasterize(backgrounds=[[1, 1, 1]])),
    ("background", TypeError, lambda: reference.render(MODEL(), scene().train.camera(0), [0.0, 0.0, 0.0])),
    ("moments", TypeError, lambda: photometric_loss(PHOTO, PHOTO, moments=PHOTO)),
    ("images", TypeError, lambda: views((255 * scene().train.images).byte())),
    ("images", TypeError, lambda: views(scene().train.images.numpy())),
    ("extrinsics", TypeError, lambda: camera_extent(scene().train.cameras)),
    ("views", TypeError, lambda: initial_points(scene())),
    ("scene", TypeError, lambda: Trainer(scene().train, make_plan(scene(), CONFIG, points()), points())),
    ("plan", TypeError, lambda: Trainer(scene(), CONFIG, points())),
    ("scene", TypeError, lambda: fit_scene(scene().train, CONFIG)),
    ("scene", TypeError, lambda: make_plan(scene().train, CONFIG, points())),
    ("config", TypeError, lambda: make_plan(scene(), {}, points())),
    ("points", TypeError, lambda: make_plan(scene(), CONFIG, points().points)),
    ("points", TypeError, lambda: Trainer(scene(), make_plan(scene(), CONFIG, points()), points().points)),
    ("names", ValueError, lambda: views(scene().train.images, ("a", "a"))),
    ("sh_degree", ValueError, lambda: rasterize(colors=torch.rand(4, 4, 3), sh_degree=1.0)),
    ("radial_coeffs", ValueError, lambda: rasterize(radial_coeffs=np.zeros((1, 4)))),
    ("seed", ValueError, lambda: synthetic_scene(seed=-1)),
    ("offset", ValueError, lambda: save_glb("x.glb", MODEL, UPRIGHT, torch.tensor([0.0, float("nan"), 0.0]))),
    ("offset", ValueError, lambda: save_glb("x.glb", MODEL, UPRIGHT, torch.zeros(2))),
    ("rotation", ValueError, lambda: save_glb("x.glb", MODEL, torch.eye(4))),
]


@pytest.mark.parametrize(("name", "error", "call"), WRONG, ids=[f"{i}-{case[0]}" for i, case in enumerate(WRONG)])
def test_something_else_is_an_error_that_names_the_argument(name, error, call):
    with pytest.raises(error, match=f"^{name}:"):
        call()


def test_numbers_of_numpy_are_taken(tmp_path):
    write_colmap(tmp_path)
    held_out = load_scene(tmp_path, hold_out=np.int64(2), downscale=np.float32(1))
    assert held_out.train.names == load_scene(tmp_path, hold_out=2).train.names
    MODEL.sh_degree = np.int64(0)
    assert MODEL.sh_degree == 0
    projected = kgs.project(random_gaussians(4, 0, torch.float32), random_views(1).cameras)
    kgs.composite(projected, projected.colors, chunk_size=np.int64(4))


def test_paths_may_be_text(tmp_path):
    trainer = Trainer(scene(), make_plan(scene(), CONFIG, points()), points())
    trainer.train_step()
    trainer.save(str(tmp_path / "c.safetensors"))
    assert Trainer.resume(scene(), CONFIG, str(tmp_path / "c.safetensors")).step == 1
    render = lambda camera: torch.zeros(1, 3, int(camera.height), int(camera.width))  # noqa: E731
    assert write_film(str(tmp_path / "a.webm"), render, scene().train, 1.0) == "" or not (tmp_path / "a.webm").exists()


def test_points_of_the_right_kind_are_taken():
    mine = InitialPoints(points().points, points().colors, "mine")
    init = Trainer(scene(), make_plan(scene(), CONFIG, mine), mine).state.start.init
    assert init == {"kind": "mine", "points": len(mine.points)}
