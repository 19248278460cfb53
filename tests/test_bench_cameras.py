"""The count of right, wrong and refused cameras, with true ones, turned or refused, in the place of found ones."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from kornia.geometry.liegroup import Se3

from kgs.bench import cameras
from kgs.bench.cameras import DISTANCE, arc_cell, write_arcs
from kgs.datasets.scene import pinholes
from kgs.datasets.synthetic import synthetic_views
from kgs.errors import DataError
from kgs.geometry import camera_centers

CELL = {"world": 1, "photos": 3, "spacing": 10.0, "size": (24, 32)}


@pytest.fixture
def found(monkeypatch):
    """Makes the true cameras, changed by a function, those that are found; returns the folders that were asked for."""

    def use(change, focal=1.0):
        made, asked = [], []

        def views(*arguments, **options):
            made.append(synthetic_views(*arguments, **options))
            return made[-1]

        def pose(folder, out, **_):
            asked.append(sorted(path.name for path in folder.iterdir()))
            return {"focal_px": focal * float(made[-1].cameras.fx[0])}

        def load(*_, **__):
            given = made[-1].cameras
            poses = change(given.extrinsics.clone())
            return SimpleNamespace(train=replace(made[-1], cameras=pinholes(given.intrinsics, poses, (24, 32))))

        monkeypatch.setattr(cameras, "synthetic_views", views)
        monkeypatch.setattr(cameras, "pose_photos", pose)
        monkeypatch.setattr(cameras, "load_scene", load)
        return asked

    return use


def elsewhere(poses):
    """The same cameras in a world that is turned, moved and 2.5 times as large."""
    turn = Se3.exp(torch.tensor([[0.3, -0.2, 0.1, 0.5, -0.4, 0.8]])).matrix().detach()
    poses = poses @ turn
    poses[:, :3, 3] *= 2.5
    return poses


def one_turned(poses):
    poses[1] = Se3.exp(torch.tensor([[0.0, 0.0, 0.0, 0.0, 0.05, 0.0]])).matrix()[0].detach() @ poses[1]
    return poses


def test_the_right_cameras_of_another_world_are_right(found):
    asked = found(elsewhere, focal=1.03)
    result = arc_cell(CELL)
    assert asked == [["photo_00.png", "photo_01.png", "photo_02.png"]]
    assert result["accepted"]
    assert result["focal"] == pytest.approx(0.03, abs=1e-5)
    assert result["degrees"] < 0.01
    assert result["distances"] < 1e-5


def test_a_turned_camera_and_a_moved_one_are_told(found):
    found(one_turned)
    assert arc_cell(CELL)["degrees"] == pytest.approx(torch.rad2deg(torch.tensor(0.05)).item(), rel=1e-3)


def test_a_refusal_is_a_result(found, monkeypatch):
    def refuse(folder, out, **_):
        raise DataError(folder, "", "no two of the 3 photos overlap. Take others\nMatches of each pair")

    found(elsewhere)
    monkeypatch.setattr(cameras, "pose_photos", refuse)
    assert arc_cell(CELL) == {"accepted": False, "why": "no two of the 3 photos overlap"}


def test_photos_are_on_an_arc():
    views = synthetic_views(torch.tensor([[0.0, 0.0, -DISTANCE], [1.0, -0.2, -3.0]]).double().numpy(), size=(12, 16))
    centers = camera_centers(views.cameras.extrinsics)
    assert (centers[1] - centers[0]).tolist() == pytest.approx([1.0, -0.2, DISTANCE - 3.0], abs=1e-5)
    assert views.images.shape == (2, 3, 12, 16)


def test_the_table_counts(tmp_path):
    good = {"accepted": True, "degrees": 0.1, "focal": -0.05, "distances": 0.002}
    results = [good, good | {"degrees": 3.0}, good | {"focal": 0.2}, {"accepted": False, "why": "x"}]
    rows = [
        {"cell": {"world": 0, "photos": 3, "spacing": spacing}, "result": result}
        for spacing, result in zip((1.0, 5.0, 10.0, 15.0), results, strict=True)
    ]
    text = write_arcs(rows, tmp_path)
    assert "| 3 | 1 | 2 | 1 | 1 of 3 | 1 to 10 | 3.00 | 0.200 | 0.0020 |" in text
    assert text == (tmp_path / "cameras.md").read_text()
