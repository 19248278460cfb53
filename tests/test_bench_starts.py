"""The measures of first points in closed form, on a plane and on the synthetic scene, and their program."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch
from init_point_scenes import garden_from_above
from kornia.geometry.camera import PinholeCamera

from kgs.bench import starts
from kgs.bench.starts import complete_pixels, depth_errors
from kgs.datasets.scene import Views
from kgs.errors import DataError
from kgs.geometry import unproject

HEIGHT, WIDTH, FOCAL, DEPTH = 24, 40, 32.0, 4.0


def at(*centers: tuple[float, float, float]) -> Views:
    """Grey views from these places, along z."""
    count = len(centers)
    intrinsics = torch.diag(torch.tensor([FOCAL, FOCAL, 1.0, 1.0])).repeat(count, 1, 1)
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    extrinsics = torch.eye(4).repeat(count, 1, 1)
    extrinsics[:, :3, 3] = -torch.tensor(centers)
    sizes = (torch.full((count,), float(size)) for size in (HEIGHT, WIDTH))
    names = tuple(str(view) for view in range(count))
    return Views(PinholeCamera(intrinsics, extrinsics, *sizes), torch.full((count, 3, HEIGHT, WIDTH), 0.5), names)


def points_of(views: Views, depths: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    """The surface of every pixel, moved along its ray to so many times its depth."""
    view, y, x = (depths > 0).nonzero().unbind(1)
    return unproject(torch.stack([x, y], 1), factor * depths[view, y, x], view, views.cameras)


@pytest.fixture(scope="module")
def plane() -> tuple[Views, torch.Tensor]:
    """A plane across the axes of two cameras, whose pictures of it are shifted by 4 pixels."""
    shift = 4 * DEPTH / FOCAL
    return at((0.0, 0.0, 0.0), (shift, 0.0, 0.0)), torch.full((2, HEIGHT, WIDTH), DEPTH, dtype=torch.float64)


def test_points_on_the_plane_are_right_and_complete(plane: tuple[Views, torch.Tensor]) -> None:
    views, truth = plane
    points = points_of(views, truth)
    assert float(depth_errors(points, views, truth).abs().max()) < 1e-12
    assert complete_pixels(points, views, truth).all()


@pytest.mark.parametrize(("factor", "is_close"), [(1.03, False), (0.97, False), (1.019, True), (0.981, True)])
def test_points_moved_along_their_rays_err_by_as_much(
    plane: tuple[Views, torch.Tensor], factor: float, is_close: bool
) -> None:
    views, truth = plane
    points = points_of(views, truth, factor)
    assert depth_errors(points, views, truth).numpy() == pytest.approx(factor - 1, abs=1e-12)
    complete = complete_pixels(points, views, truth)
    assert bool(complete.all()) if is_close else not complete.any()


def test_a_point_completes_the_pixels_around_it(plane: tuple[Views, torch.Tensor]) -> None:
    views, truth = plane
    found = complete_pixels(points_of(views, truth)[[12 * WIDTH + 20]], views, truth)
    assert found.sum((1, 2)).tolist() == [13, 13]  # the pixels of a disc with a radius of 2
    assert found[0, 10:15, 20].all()
    assert found[1, 12, 14:19].all()
    corner = complete_pixels(points_of(views, truth)[[0]], views, truth)
    assert corner.sum((1, 2)).tolist() == [6, 0]  # the other view has it 4 pixels out of its picture


def test_a_hidden_point_is_judged_where_it_is_seen() -> None:
    """A surface at 2 before the nearer camera hides the plane that the other one sees."""
    views = at((0.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    truth = torch.tensor([2.0, 5.0], dtype=torch.float64)[:, None, None].repeat(1, HEIGHT, WIDTH)
    points = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, 4.1], [0.0, 0.0, 2.02], [0.0, 0.0, 7.0]])
    errors = depth_errors(points, views, truth)
    assert errors.tolist() == pytest.approx([0.0, 0.1 / 5, 0.01, 2.5], abs=1e-6)  # the last: hidden from both


def test_points_before_nothing_and_outside(plane: tuple[Views, torch.Tensor]) -> None:
    views, truth = plane[0], torch.zeros_like(plane[1])
    errors = depth_errors(torch.tensor([[0.0, 0.0, 3.0], [50.0, 0.0, 3.0], [0.0, 0.0, -3.0]]), views, truth)
    assert errors.tolist() == [-1.0, torch.inf, torch.inf]
    assert not complete_pixels(torch.tensor([[0.0, 0.0, 3.0]]), views, truth).any()


def test_points_of_the_exact_depths_of_the_synthetic_scene() -> None:
    views, truth = garden_from_above((63, 84))
    points = points_of(views, truth)
    for view in range(3):  # alone: each point falls on the centre of its pixel
        alone = views.select([view]), truth[[view]]
        assert float(depth_errors(points_of(*alone), *alone).abs().max()) < 1e-5  # float32 cameras
    errors = depth_errors(points, views, truth).abs()
    assert float(errors.median()) < 1e-5
    assert float((errors < 0.01).double().mean()) > 0.97  # the rest lies at edges
    assert complete_pixels(points, views, truth).all()
    moved = depth_errors(points_of(views, truth, 1.03), views, truth)
    assert float(moved.median()) == pytest.approx(0.03, abs=0.003)
    assert float((moved.abs() < 0.02).double().mean()) < 0.03


def test_a_fallback_is_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(starts, "ALL_POINTS", 500)
    monkeypatch.setattr(starts, "RANDOM_POINTS", 300)
    found, row = starts._find(at((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)), "dense", 0)
    assert (row["asked"], row["came"], row["points"]) == ("dense", "random", 300)
    assert "agree on 0 points only" in row["fallback"]
    assert "random points instead" in row["fallback"]
    assert found.shape == (300, 3)
    assert row["cpu_seconds"] > 0


def test_the_files_of_the_quick_program(tmp_path: Path) -> None:
    starts.starts(out=tmp_path, quick=True)
    rows = json.loads((tmp_path / "starts.json").read_text())["rows"]
    assert (rows[0]["came"], rows[0]["fallback"]) == ("dense", "")
    assert [row["asked"] for row in rows] == ["dense", "sift", "random"]
    with (tmp_path / "starts.csv").open(newline="") as file:
        assert [float(row["median_error"]) for row in csv.DictReader(file)] == [row["median_error"] for row in rows]
    assert (tmp_path / "starts.md").read_text().count("| room | 3 | 168x126 | dense | 1 |") == 2
    dense, _, random = rows
    assert dense["median_error"] < 0.02 < 0.1 < random["median_error"]
    assert dense["complete"] > 1.5 * random["complete"]


def test_a_missing_scene_is_named_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KGS_DATA", str(tmp_path))
    with pytest.raises(DataError, match="llff/fern"):
        starts.starts(out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
