"""What the viewer is told about the cameras: where it opens, and how large their pyramids are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from factories import batch, looking_at, pinhole
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kgs.app.files import film
from kgs.app.page.cameras import viewer_scene
from kgs.datasets.scene import Views

MEANS = torch.tensor([[0.0, 0.0, 4.0]])


def camera(x: float, degrees: float = 0.0) -> PinholeCamera:
    """A camera at `(x, 0, 0)`, turned about its vertical axis."""
    pose = torch.eye(4).double()
    pose[:3, :3] = axis_angle_to_rotation_matrix(torch.tensor([[0.0, math.radians(degrees), 0.0]]).double())[0]
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, 0.0, 0.0]).double()
    return pinhole(60, 80, (80.0, 80.0), (39.5, 29.5), 0.0, pose)


def first(cameras: list[PinholeCamera], parts: list[str], means: Tensor = MEANS) -> int:
    found: int = viewer_scene(batch(*cameras), [str(i) for i in range(len(cameras))], parts, means)["first"]
    return found


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_the_viewer_opens_in_the_middle(order: tuple[int, ...]) -> None:
    side_by_side = [(-1.0, 0.0), (0.1, 0.0), (1.0, 0.0)]
    turned = [(0.0, -20.0), (0.0, 3.0), (0.0, 20.0)]
    for poses in (side_by_side, turned):
        assert first([camera(*poses[i]) for i in order], ["training"] * 3) == order.index(1)


def test_it_opens_at_a_training_camera() -> None:
    cameras = [camera(0.0), camera(-1.0), camera(0.2), camera(1.0)]
    assert first(cameras, ["test", "training", "training", "training"]) == 2
    assert first(cameras, ["test", "test", "test", "test"]) == 0
    assert first(cameras, ["photo"] * 4) == 0
    assert first([camera(0.0)], ["training"], MEANS[:0]) == 0  # one camera and no Gaussians


def test_it_opens_at_the_best_of_the_middle_third() -> None:
    cameras = [camera(x) for x in (-1.0, -0.6, -0.1, 0.12, 0.5, 1.1)]
    names = list("abcdef")

    def opens_at(**psnr: float) -> str:
        scene = viewer_scene(batch(*cameras), names, ["training"] * 6, MEANS, psnr)
        return names[scene["first"]]

    assert opens_at() == "c"
    assert opens_at(a=40.0, c=26.6, d=32.7, e=35.0) == "d"
    assert opens_at(a=40.0, c=26.6) == "c"  # that of d is not known
    assert opens_at(c=30.0, d=30.0) == "c"


def around(*degrees: float, height: float = 0.0) -> dict[str, Any]:
    """What the viewer gets of cameras at these angles on a circle around the Gaussian, which they look at."""
    angles = torch.tensor(degrees).double().deg2rad()
    offsets = torch.stack([angles.sin(), torch.full_like(angles, -height), -angles.cos()], 1)
    poses = looking_at(MEANS[0], MEANS.double() + 4.0 * offsets, torch.tensor([0.0, -1.0, 0.0]))
    cameras = batch(*(pinhole(60, 80, (80.0, 80.0), (39.5, 29.5), 0.0, pose) for pose in poses))
    return viewer_scene(cameras, ["a"] * len(poses), ["training"] * len(poses), MEANS)


@pytest.mark.parametrize("degrees", [(-20.0, 0.0, 30.0), (160.0, 180.0, -150.0), (70.0, 90.0, 120.0), (0.0, 50.0)])
def test_the_arc_is_that_of_the_cameras(degrees: tuple[float, ...]) -> None:
    arc = around(*degrees)["arc"]
    low, high = arc["yaw"]
    assert high - low == pytest.approx(math.radians(50))
    assert low <= 1e-9
    assert high >= -1e-9  # the first camera, at 0, is on it
    assert arc["pitch"] == pytest.approx([-0.15, 0.15])


def test_the_arc_of_cameras_all_around_has_no_limit_and_reaches_up_to_them() -> None:
    assert around(0.0, 90.0, 180.0, 270.0)["arc"]["yaw"] is None
    assert around(0.0, 90.0, 180.0)["arc"]["yaw"] is not None
    low, high = around(0.0, 120.0, 240.0, height=1.0)["arc"]["pitch"]
    assert (low + high) / 2 == pytest.approx(math.pi / 4)


def test_the_arc_and_the_tour_are_those_of_the_cameras_of_the_film() -> None:
    """Turned pictures too, whose yaw is the pitch of the others."""
    cameras = [camera(0.0, degrees) for degrees in (-30.0, 0.0, 30.0)]
    path = batch(*(camera(0.0, degrees) for degrees in (-10.0, 0.0, 30.0)))
    scene = viewer_scene(batch(*cameras), list("abc"), ["training"] * 3, MEANS, path=path)
    wide = math.radians(40)
    for arc, name in ((scene["arc"], "yaw"), (scene["turned"][0]["arc"], "pitch"), (scene["turned"][1]["arc"], "yaw")):
        assert arc[name][1] - arc[name][0] == pytest.approx(wide)
    ahead = torch.tensor([pose["rotation"] for pose in scene["tour"]["poses"]])[:, 2]
    turns = torch.atan2(ahead[:, 0], ahead[:, 2]).rad2deg()
    assert float(turns.max() - turns.min()) == pytest.approx(40, abs=0.5)


def test_a_single_camera_has_a_small_arc_also_one_that_looks_down() -> None:
    assert around(0.0)["arc"]["yaw"] == pytest.approx([-0.15, 0.15])
    down = torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    cameras = pinhole(60, 80, (80.0, 80.0), (39.5, 29.5), 0.0, down.double())
    arc = viewer_scene(cameras, ["a"], ["photo"], torch.tensor([[0.0, 4.0, 0.0]]))["arc"]
    assert np.isfinite([*arc["origin"], *arc["yaw"], *arc["pitch"]]).all()
    assert np.linalg.norm(arc["origin"]) == pytest.approx(1)


@pytest.mark.parametrize("size", [1e-5, 1.0, 1e5])
def test_the_tour_is_the_path_of_the_film(tmp_path: Path, monkeypatch: Any, size: float) -> None:
    """Of scenes of any size: against the cameras that the film of the training views is rendered from."""
    monkeypatch.setattr(film, "FRAMES", 144)
    cameras = batch(*(camera(size * x) for x in (-1.0, 0.1, 0.7, 2.0)))
    parts = ["training"] * 3 + ["test"]
    tour = viewer_scene(cameras, list("abcd"), parts, size * MEANS)["tour"]
    filmed = []

    def render(one: PinholeCamera) -> Tensor:
        filmed.append(one.extrinsics[0])
        return torch.zeros(1, 3, 60, 80)

    views = Views(cameras, torch.zeros(4, 3, 60, 80), tuple("abcd")).select([0, 1, 2])
    assert film.write_film(tmp_path / "a.webm", render, views, 4 * size) == ""
    assert tour["seconds"] == len(filmed) / 24
    poses = torch.stack(filmed)
    rotations = torch.tensor([pose["rotation"] for pose in tour["poses"]]).double()
    positions = torch.tensor([pose["position"] for pose in tour["poses"]]).double()
    torch.testing.assert_close(rotations, poses[:, :3, :3], rtol=0, atol=1e-6)
    torch.testing.assert_close(positions, torch.linalg.inv(poses)[:, :3, 3], rtol=0, atol=1e-5 * size)


def test_pyramids_are_smaller_than_the_distance_of_neighbours() -> None:
    def pyramid(*centers: float) -> float:
        cameras = batch(*map(camera, centers))
        found: float = viewer_scene(cameras, ["a"] * len(centers), ["training"] * len(centers), MEANS)["pyramid"]
        return found

    assert pyramid(0.0, 0.1, 0.2) == pytest.approx(0.03)
    assert pyramid(0.0) == pyramid(0.0, 1.5) == pyramid(0.0, 0.0) == pytest.approx(0.4)  # a tenth of the depth
