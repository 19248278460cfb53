"""What the viewer is told about the cameras: where it opens, and how large their pyramids are."""

from __future__ import annotations

import math

import pytest
import torch
from factories import batch, pinhole
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from kgs.page.cameras import viewer_scene

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


def test_one_camera_and_no_gaussians() -> None:
    assert first([camera(0.0)], ["training"], MEANS[:0]) == 0


def test_pyramids_are_smaller_than_the_distance_of_neighbours() -> None:
    def pyramid(*places: float) -> float:
        cameras = batch(*map(camera, places))
        found: float = viewer_scene(cameras, ["a"] * len(places), ["training"] * len(places), MEANS)["pyramid"]
        return found

    assert pyramid(0.0, 0.1, 0.2) == pytest.approx(0.03)
    assert pyramid(0.0) == pyramid(0.0, 1.5) == pyramid(0.0, 0.0) == pytest.approx(0.4)  # a tenth of the depth
