"""How far the film and the viewer go: to where two photos show most of what is seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from factories import pinhole

import kgs
from kgs.app.files import exports
from kgs.app.files.reach import film_views
from kgs.datasets import Scene
from kgs.datasets.scene import Views
from kgs.fit import Fit
from kgs.geometry.rigs import camera_centers


def fit_of(*positions: float) -> Fit:
    """A wall at a depth of 4, and cameras before it at these x, whose images are 4 wide there."""
    x, y = torch.meshgrid(torch.linspace(-4, 6, 100), torch.linspace(-2, 2, 40), indexing="ij")
    points = torch.stack([x, y, torch.full_like(x, 4.0)], -1).reshape(-1, 3)
    model = kgs.GaussianModel.from_points(points, torch.rand(len(points), 3), 0)
    with torch.no_grad():
        model.opacity_logits += 5.0
    poses = torch.eye(4).repeat(len(positions), 1, 1)
    poses[:, 0, 3] = -torch.tensor(positions)
    cameras = pinhole(60, 80, (80.0, 80.0), (39.5, 29.5), dtype=torch.float32, cameras=len(positions))
    names = tuple(f"{i}.png" for i in range(len(positions)))
    views = Views(kgs.cameras.posed(cameras, poses), torch.rand(len(positions), 3, 60, 80), names)
    none = torch.zeros(0, 3)
    scene = Scene(views, views.select([]), none, none, "none", torch.zeros(3).double(), torch.zeros(3), Path())
    return Fit(scene, model, kgs.RasterOptions())


def test_a_camera_whose_image_one_photo_shows_moves_to_where_two_show_it() -> None:
    """The share that another photo shows too of what the last one sees is 1 - (x - 0.4) / 4."""
    fit = fit_of(0.0, 0.4, 2.0)
    views, best = film_views(fit)
    centers = camera_centers(views.cameras.extrinsics)
    assert best == 1  # the photos to both sides show all of it
    torch.testing.assert_close(centers[:2], torch.tensor([[0.0, 0, 0], [0.4, 0, 0]]).double(), rtol=0, atol=1e-6)
    assert centers[2, 1:].abs().max() < 1e-6
    assert 0.4 + 0.1 * 4 - 1.6 / 8 < centers[2, 0] < 0.4 + 0.1 * 4 + 0.1  # steps, and pixels of the small image


def test_a_camera_that_looks_the_other_way_is_left_for_the_nearest_that_shows_enough() -> None:
    """The path between them would lead through the scene, or through a point where a camera has no direction."""
    fit = fit_of(0.0, 0.4, 0.5)
    poses = fit.scene.train.cameras.extrinsics.clone()
    poses[2] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ poses[2]  # sees nothing
    train = replace(fit.scene.train, cameras=kgs.cameras.posed(fit.scene.train.cameras, poses))
    views, _ = film_views(Fit(replace(fit.scene, train=train), fit.model, fit.options))
    torch.testing.assert_close(views.cameras.extrinsics[2], poses[1])


@pytest.mark.parametrize("positions", [(0.0,), (0.0, 9.0), (0.0, 0.1, 0.2)], ids=["one", "apart", "near"])
def test_without_a_better_one_all_stay(positions: tuple[float, ...]) -> None:
    fit = fit_of(*positions)
    views, _ = film_views(fit)
    torch.testing.assert_close(views.cameras.extrinsics, fit.scene.train.cameras.extrinsics)


def test_film_and_still_are_seen_from_there(tmp_path: Path, monkeypatch: Any) -> None:
    """Also of pictures that are turned, whose cameras turn with them."""
    fit = fit_of(0.0, 0.4, 2.0)
    seen: dict[str, Any] = {}
    monkeypatch.setattr(exports, "write_film", lambda _path, _render, views, *_: seen.update(film=views) or "")
    monkeypatch.setattr(exports, "write_preview", lambda _path, _fit, views, index: seen.update(still=(views, index)))
    expected, _ = film_views(replace(fit))
    for roll in (0.0, 90.0):
        exports.write_exports(fit, tmp_path, roll)
        views, best = seen["still"]
        assert views is seen["film"]
        assert best == 1
        found = camera_centers(views.cameras.extrinsics)
        torch.testing.assert_close(found, camera_centers(expected.cameras.extrinsics), rtol=0, atol=0.2)
    assert views.images.shape[-2:] == (80, 60)
