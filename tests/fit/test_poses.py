"""Training cameras that a fit moves: towards the truth, never far, and with nothing moved that all have in common."""

import json
import math
import shutil
from dataclasses import replace

import pytest
import torch
from fits_in_folders import fit_in
from kornia.geometry.liegroup import Se3
from refusals import refused
from tiny_scenes import write_llff

from kgs._support.errors import DataError
from kgs.app.cli.evaluate import evaluate
from kgs.app.files.fit_files import CHECKPOINT
from kgs.app.saved_fit import load_fit
from kgs.app.scene_request import SceneRequest
from kgs.datasets import load_scene, synthetic_scene
from kgs.fit import FitConfig, Trainer
from kgs.fit.checkpoint import load_checkpoint, save_checkpoint
from kgs.fit.plan import make_plan
from kgs.fit.poses import REACH, CameraOptimizer, decayed, with_extrinsics
from kgs.fit.run import choose_points
from kgs.geometry.rigs import camera_centers

CONFIG = FitConfig(steps=6, seed=5, init="random", init_points=200, sh_degree=0, evaluations=1, refine_poses=True)
DEPTH = 1.0


def turned(extrinsics, degrees, seed):
    """The poses, each turned about its centre, by up to so much; the turns have no common part."""
    generator, poses = torch.Generator().manual_seed(seed), extrinsics.double()
    turns = torch.randn(len(poses), 3, generator=generator, dtype=torch.float64)  # in the world
    turns = turns - turns.mean(dim=0)
    turns *= math.radians(degrees) / turns.norm(dim=1).max()
    motion = torch.zeros(len(poses), 6, dtype=torch.float64)
    motion[:, 3:] = (poses[:, :3, :3] @ turns[..., None])[..., 0]
    return (Se3.exp(motion).matrix() @ poses).detach()


def degrees_apart(extrinsics, others):
    """The worst error of a rotation between two cameras."""
    one, two = extrinsics[:, :3, :3].double(), others[:, :3, :3].double()
    between = [(r[:, None] @ r[None].mT) for r in (one, two)]
    sines = torch.linalg.matrix_norm(between[0] - between[1]) / 8**0.5
    return float(2 * sines.max().asin().rad2deg())


def in_common(extrinsics):
    """Mean and spread of the centres."""
    centers = camera_centers(extrinsics)
    return centers.mean(dim=0), (centers - centers.mean(dim=0)).norm()


@pytest.fixture(scope="module")
def room():
    return synthetic_scene(train_views=3, test_views=1, size=(36, 48))


def pulled(poses, scene, targets, steps):
    """Steps down the squared distance of each pose from its target, one camera after the other."""
    for step in range(steps):
        view = step % len(targets)
        camera = poses.camera(scene.train.camera(view), view)
        (camera.extrinsics[0, :3] - targets[view, :3].to(camera.extrinsics)).square().sum().backward()
        poses.step((step + 1) / steps)
    return with_extrinsics(scene, poses.extrinsics)


def test_cameras_follow_their_gradient(room):
    given = room.train.cameras.extrinsics
    wrong = turned(given, 0.15, seed=1)  # within reach
    scene = with_extrinsics(room, wrong)
    poses = CameraOptimizer(scene.train.cameras.extrinsics, steps=600, depth=DEPTH)
    scene = pulled(poses, scene, given, 600)
    assert degrees_apart(wrong, given) > 0.15
    assert degrees_apart(scene.train.cameras.extrinsics, given) < 0.02
    assert torch.equal(scene.test.cameras.extrinsics, room.test.cameras.extrinsics)


def test_what_cameras_have_in_common_stays(room):
    given = room.train.cameras.extrinsics
    poses = CameraOptimizer(given, steps=30, depth=DEPTH)
    pulled(poses, room, turned(given, 20.0, seed=2), 30)
    for now, before in zip(in_common(poses.extrinsics), in_common(given), strict=True):
        torch.testing.assert_close(now, before, rtol=0, atol=1e-6)
    relative = (poses.extrinsics[:, :3, :3].mT @ given[:, :3, :3].double()).sum(dim=0)
    torch.testing.assert_close(relative, relative.mT, rtol=0, atol=1e-6)  # no rotation would make the sum larger
    assert poses.moved()["degrees"] > 0.05


def test_none_goes_farther_than_its_reach(room):
    """However steep: a gradient of 1e12, on the way to 90 degrees."""
    given = room.train.cameras.extrinsics
    poses = CameraOptimizer(given, steps=90, depth=DEPTH)
    for step in range(90):
        camera = poses.camera(room.train.camera(step % 3), step % 3)
        (1e12 * camera.extrinsics[0, 0, 2]).backward()
        poses.step((step + 1) / 90)
    assert poses.moved()["max_degrees"] < math.degrees(2 * 3**0.5 * REACH)
    orthogonal = poses.extrinsics[:, :3, :3] @ poses.extrinsics[:, :3, :3].mT
    torch.testing.assert_close(
        orthogonal, torch.eye(3, dtype=torch.float64).expand(3, 3, 3), rtol=0, atol=1e-6
    )  # as given


@pytest.mark.parametrize("slope", [math.nan, math.inf, None])
def test_no_step_without_a_finite_gradient(room, slope):
    poses = CameraOptimizer(room.train.cameras.extrinsics, steps=5, depth=DEPTH)
    camera = poses.camera(room.train.camera(0), 0)
    if slope is not None:
        (slope * camera.extrinsics.sum()).backward()
    poses.step(0.2)
    assert torch.equal(poses.extrinsics, room.train.cameras.extrinsics.double())
    assert poses.moved()["max_degrees"] == 0


@pytest.mark.slow
def test_a_fit_turns_wrong_cameras_back():
    scene = synthetic_scene(train_views=3, test_views=1, size=(48, 64))
    wrong = with_extrinsics(scene, turned(scene.train.cameras.extrinsics, 0.7, seed=5))
    config = FitConfig(steps=150, seed=1, sh_degree=0, init_points=1500, max_gaussians=2000, evaluations=1)
    points = choose_points(wrong, config)
    fits = [
        Trainer(wrong, make_plan(wrong, replace(config, refine_poses=moves), points), points).fit()
        for moves in (False, True)
    ]
    fixed, moved = fits
    given, found = scene.train.cameras.extrinsics, moved.scene.train.cameras.extrinsics
    assert degrees_apart(found, given) < 0.75 * degrees_apart(wrong.train.cameras.extrinsics, given)
    assert moved.psnr(moved.scene.train) > fixed.psnr(wrong.train) + 0.3
    assert moved.psnr(scene.test) > fixed.psnr(scene.test)
    assert fixed.scene is wrong


@pytest.fixture(scope="module")
def refined(tmp_path_factory):
    """A scene of three photos, and the folder of a fit that moved its cameras."""
    root = tmp_path_factory.mktemp("scene")
    out = tmp_path_factory.mktemp("out")
    write_llff(root)
    request = SceneRequest(str(root))
    fit_in(request.load(out), CONFIG, out, request, say=lambda line: None)
    return root, out


def test_files_are_about_the_moved_cameras(refined):
    """The page, cameras.json and a later `kgs eval` see the training views from where the fit has them."""
    root, out = refined
    metrics = json.loads((out / "metrics.json").read_text())
    scene = load_fit(out)[1].scene
    given = load_scene(root).train.cameras.extrinsics
    assert 0 < metrics["poses"]["degrees"] <= metrics["poses"]["max_degrees"]
    listed = json.loads((out / "cameras.json").read_text())[: len(given)]
    centers = torch.tensor([entry["position"] for entry in listed]) - scene.offset
    torch.testing.assert_close(centers, camera_centers(scene.train.cameras.extrinsics), rtol=0, atol=1e-6)
    assert not torch.allclose(centers, camera_centers(given), rtol=0, atol=1e-6)
    assert "moved the training cameras by" in (out / "index.html").read_text()
    evaluate(out)
    again = json.loads((out / "metrics.json").read_text())
    assert again["train"]["psnr"] == pytest.approx(metrics["train"]["psnr"], abs=1e-6)
    assert "moved the training cameras by" in (out / "index.html").read_text()


def test_poses_of_other_photos_are_refused(refined, tmp_path):
    """A photo was added to the scene, or removed, after the fit that refined its poses."""
    out = tmp_path / "out"
    shutil.copytree(refined[1], out)
    values = load_checkpoint(out / CHECKPOINT)
    values["poses"]["extrinsics"] = values["poses"]["extrinsics"][1:]
    save_checkpoint(out / CHECKPOINT, values)
    with refused(DataError, key="train", advice="fit again"):
        load_fit(out)


def test_decayed():
    assert decayed(1.0, 0.01, 0.5) == pytest.approx(0.1)
    assert decayed(2.0, 0.5, 0.0) == pytest.approx(2.0)
    assert decayed(2.0, 0.5, 1.0) == pytest.approx(0.5)
