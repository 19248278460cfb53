"""What the photos show, as the viewer gets it: no range of depths is narrower than what the cameras see."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
import pytest
import torch
from factories import batch, random_camera, random_gaussians

from kgs import GaussianRenderer, Gaussians
from kgs.page import seen

SIZE = (30, 45)


def decoded(found: seen.Seen) -> tuple[Any, Any]:
    """Nearest and farthest depths, `(V, h, w)`; NaN in empty cells."""
    layout = found.layout
    shape = (2, len(layout["views"]), layout["height"], layout["width"])
    codes = np.frombuffer(gzip.decompress(found.content), np.uint8).reshape(shape).astype(float)
    depths = np.where(codes[:1] > codes[1:], np.nan, np.exp(layout["low"] + layout["step"] * (codes - 1)))
    return depths[0], depths[1]


@pytest.mark.parametrize("most_cells", [9, 128])
def test_each_pixel_lies_in_the_range_of_its_cell(monkeypatch: pytest.MonkeyPatch, most_cells: int) -> None:
    monkeypatch.setattr(seen, "MOST_CELLS", most_cells)
    gaussians = random_gaussians(80, 0, torch.float32, image_size=max(SIZE))
    cameras = batch(*(random_camera(*SIZE, seed, torch.float32) for seed in range(3)))
    found = seen.seen_by(gaussians, cameras, [0, 2], 0.01)
    assert found.layout["views"] == [0, 2]
    cell = found.layout["cell"]
    assert (found.layout["height"], found.layout["width"]) == tuple(-(-side // cell) for side in SIZE)
    near, far = decoded(found)
    with torch.no_grad():
        rendering = GaussianRenderer(near_plane=0.01).eval()(gaussians, cameras, outputs=("alpha", "depth"))
    for place, view in enumerate((0, 2)):
        depth, alpha = rendering.depth[view, 0].numpy(), rendering.alpha[view, 0].numpy()
        rows, columns = np.nonzero(alpha >= 0.06)
        values = depth[rows, columns]
        low, high = near[place, rows // cell, columns // cell], far[place, rows // cell, columns // cell]
        assert (low <= values * (1 + 1e-5)).all()
        assert (values <= high * (1 + 1e-5)).all()
        for row, column in zip(rows[::50], columns[::50], strict=True):  # and not much wider than what is there
            r, c = row // cell * cell, column // cell * cell
            around = np.s_[max(r - 1, 0) : r + cell + 1, max(c - 1, 0) : c + cell + 1]
            there = depth[around][alpha[around] >= 0.05]
            step = np.exp(1.1 * found.layout["step"])
            assert near[place, row // cell, column // cell] >= there.min() / step
            assert far[place, row // cell, column // cell] <= there.max() * step


def test_what_shows_nothing_is_empty() -> None:
    none = random_gaussians(3, 0, torch.float32)
    none = Gaussians(none.means, none.quats, none.scales, torch.zeros(3), none.colors)
    near, far = decoded(seen.seen_by(none, random_camera(*SIZE, 0, torch.float32), [0], 0.01))
    assert np.isnan(near).all()
    assert np.isnan(far).all()


def test_of_many_photos_an_even_choice_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seen, "MOST_VIEWS", 3)
    cameras = batch(*(random_camera(*SIZE, seed, torch.float32) for seed in range(7)))
    found = seen.seen_by(random_gaussians(5, 0, torch.float32), cameras, list(range(7)), 0.01)
    assert found.layout["views"] == [0, 3, 6]
