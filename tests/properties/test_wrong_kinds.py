"""Something of a near kind as an argument: a model for its Gaussians, a list for a tensor, text for a path.

What is meant is taken, and what is wrong is an error that names the argument, not one from inside torch.
"""

import functools
import re
import sys

import numpy as np
import pytest
import torch
from factories import random_gaussians, random_model, random_views
from tiny_scenes import write_colmap

import kgs
from kgs import reference
from kgs.app.files.film import write_film
from kgs.app.files.glb import save_glb
from kgs.app.fit_folder import fit_folder
from kgs.app.scene_request import SceneRequest
from kgs.datasets import Views, load_scene, synthetic_scene
from kgs.densify import Densifier
from kgs.fit import FitConfig, InitialPoints, Trainer, fit_scene, initial_points
from kgs.fit.plan import make_plan
from kgs.geometry import camera_extent
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
WRONG = {
    "a model for Gaussians": (
        lambda: kgs.GaussianRenderer()(MODEL, scene().train.camera(0)),
        "gaussians: expected Gauss",
    ),
    "and in project": (
        lambda: kgs.project(MODEL, scene().train.camera(0)),
        "gaussians: expected Gaussians, got",
    ),
    "and in the reference": (lambda: reference.render(MODEL, scene().train.camera(0)), "gaussians: expected Gaussians"),
    "Gaussians for a model": (lambda: kgs.save_ply("x.ply", MODEL()), "model: expected GaussianModel, got Gaussians"),
    "and in a glb": (lambda: save_glb("x.glb", MODEL(), UPRIGHT), "model: expected GaussianModel, got Gaussians"),
    "and in densification": (lambda: Densifier(MODEL(), None, 1.0), "model: expected GaussianModel, got Gaussians"),
    "one Gaussian": (lambda: MODEL()[0], "index: expected a mask, indices or a slice, got 0"),
    "an array of points": (
        lambda: kgs.GaussianModel.from_points(np.zeros((5, 3), np.float32), torch.rand(5, 3)),
        "points: expected a torch.Tensor, got ndarray",
    ),
    "an array of parameters": (
        lambda: kgs.GaussianModel(*(value.detach().numpy() for value in MODEL.parameters())),
        "means: expected a torch.Tensor, got ndarray",
    ),
    "means as a list": (lambda: rasterize(means=[[0.0, 0.0, 2.0]] * 4), "means: expected a torch.Tensor, got list"),
    "backgrounds as a list": (lambda: rasterize(backgrounds=[[1, 1, 1]]), "backgrounds: expected a torch.Tensor, got"),
    "a list behind the reference": (
        lambda: reference.render(MODEL(), scene().train.camera(0), [0.0, 0.0, 0.0]),
        "background: expected a torch.Tensor, got list",
    ),
    "a photo for its moments": (
        lambda: photometric_loss(PHOTO, PHOTO, moments=PHOTO),
        "moments: expected TargetMoments, got Tensor",
    ),
    "bytes for colours": (
        lambda: views((255 * scene().train.images).byte()),
        "images: expected a tensor of floating point RGB in [0, 1], got torch.uint8",
    ),
    "an array of photos": (
        lambda: views(scene().train.images.numpy()),
        "images: expected a tensor of floating point RGB",
    ),
    "cameras for their matrices": (
        lambda: camera_extent(scene().train.cameras),
        "extrinsics: expected a torch.Tensor, got PinholeCamera",
    ),
    "a scene for its views": (lambda: initial_points(scene()), "views: expected Views, got Scene"),
    "views for a scene": (
        lambda: Trainer(scene().train, make_plan(scene(), CONFIG), points()),
        "scene: expected Scene, got Views",
    ),
    "settings for a plan": (lambda: Trainer(scene(), CONFIG, points()), "plan: expected Plan, got FitConfig"),
    "and in a whole fit": (lambda: fit_scene(scene().train, CONFIG), "scene: expected Scene, got Views"),
    "and in a plan": (lambda: make_plan(scene().train, CONFIG), "scene: expected Scene, got Views"),
    "a dict for settings": (lambda: make_plan(scene(), {}), "config: expected FitConfig, got dict"),
    "a tensor for points": (
        lambda: Trainer(scene(), make_plan(scene(), CONFIG), points().points),
        "points: expected InitialPoints, got Tensor",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_another_kind_is_a_type_error_that_names_the_argument(name):
    call, message = WRONG[name]
    with pytest.raises(TypeError, match="^" + re.escape(message)):
        call()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: views(scene().train.images, ("a", "a")), "names: expected each once"),
        (lambda: rasterize(colors=torch.rand(4, 4, 3), sh_degree=1.0), "sh_degree: expected 0 to 3 or None, got 1.0"),
        (lambda: rasterize(radial_coeffs=np.zeros((1, 4))), "radial_coeffs: expected None .*, got an array"),
        (lambda: synthetic_scene(seed=-1), "seed: expected at least 0, got -1"),
        (lambda: save_glb("x.glb", MODEL, UPRIGHT, torch.tensor([0.0, float("nan"), 0.0])), "offset: expected finite"),
        (lambda: save_glb("x.glb", MODEL, UPRIGHT, torch.zeros(2)), r"offset: expected shape \(3,\)"),
        (lambda: save_glb("x.glb", MODEL, torch.eye(4)), r"rotation: expected finite numbers of shape \(3, 3\)"),
    ],
)
def test_another_value_is_a_value_error_that_names_the_argument(call, message):
    with pytest.raises(ValueError, match="^" + message):
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
    trainer = Trainer(scene(), make_plan(scene(), CONFIG), points())
    trainer.train_step()
    trainer.save(str(tmp_path / "c.safetensors"))
    assert Trainer.resume(scene(), CONFIG, str(tmp_path / "c.safetensors")).step == 1
    render = lambda camera: torch.zeros(1, 3, int(camera.height), int(camera.width))  # noqa: E731
    assert write_film(str(tmp_path / "a.webm"), render, scene().train, 1.0) == "" or not (tmp_path / "a.webm").exists()
    published = fit_folder(scene(), CONFIG, str(tmp_path / "out"), SceneRequest("."))
    assert published.folder == tmp_path / "out"
    assert (tmp_path / "out" / "index.html").exists()


@pytest.mark.parametrize("package", ["jinja2", "matplotlib"])
def test_a_package_that_results_need_is_missed_before_the_training(monkeypatch, tmp_path, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ModuleNotFoundError, match=package):
        fit_folder(scene(), CONFIG, tmp_path / "out", SceneRequest("."))
    assert not (tmp_path / "out").exists()


def test_points_of_the_right_kind_are_taken():
    mine = InitialPoints(points().points, points().colors, "mine")
    init = Trainer(scene(), make_plan(scene(), CONFIG), mine).state.start.init
    assert init == {"kind": "mine", "points": len(mine.points)}
