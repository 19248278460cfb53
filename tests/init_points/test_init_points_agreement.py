"""Depth maps of a wall seen by two cameras side by side: which depths are averaged, and which pixels are kept."""

import numpy as np
import pytest
import torch
from init_point_scenes import cameras

from kgs.geometry.cameras import to
from kgs.init_points import agreement
from kgs.init_points.agreement import average_depths, before_surfaces, consistent_pixels
from kgs.init_points.plane_sweep import DepthMap

WIDTH, HEIGHT, DEPTH = 40, 30, 4.0
BESIDE = cameras(np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]]), turn=0.0, size=(WIDTH, HEIGHT))
GEOMETRY = to(BESIDE, "cpu", torch.float64)
EVERYWHERE = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
SHARED = (slice(None), slice(5, None))  # of the first view: the second camera sees it 3.5 pixels further left


SQUARE = 6  # pixels, the side of a small piece of surface


def wall(depth):
    return DepthMap(torch.full((HEIGHT, WIDTH), depth), torch.ones(HEIGHT, WIDTH), EVERYWHERE)


def agreed(maps, certain):
    """Which pixels of the first view are kept."""
    return consistent_pixels(GEOMETRY, maps, certain, 0)


def test_similar_depths_are_averaged_and_agree_then():
    maps, certain = [wall(DEPTH), wall(1.025 * DEPTH)], [EVERYWHERE, EVERYWHERE]
    averaged = average_depths(GEOMETRY, maps, certain)
    expected = torch.tensor(2 / (1 / DEPTH + 1 / (1.025 * DEPTH)))
    torch.testing.assert_close(averaged[0].depths[SHARED], expected.expand(HEIGHT, WIDTH - 5))
    torch.testing.assert_close(averaged[1].depths[:, : WIDTH - 5], expected.expand(HEIGHT, WIDTH - 5))
    assert torch.equal(averaged[0].depths[:, :3], maps[0].depths[:, :3])  # outside the other image
    assert bool(agreed(averaged, certain)[SHARED].all())


@pytest.mark.parametrize("unlike", ["depth", "own mask", "other mask"])
def test_other_depths_stay(unlike):
    maps = [wall(DEPTH), wall((1.05 if unlike == "depth" else 1.02) * DEPTH)]
    masks = [EVERYWHERE & (unlike != "own mask"), EVERYWHERE & (unlike != "other mask")]
    assert torch.equal(average_depths(GEOMETRY, maps, masks)[0].depths, maps[0].depths)


def test_pixels_need_agreeing_neighbours():
    certain = torch.zeros_like(EVERYWHERE)
    certain[12:14, 14:16] = True  # alone
    certain[:, 20:] = True  # up to a straight edge
    kept = agreed([wall(DEPTH), wall(DEPTH)], [certain, EVERYWHERE])
    assert not kept[:, :20].any()
    assert bool(kept[:, 20:].all())


def test_depths_that_differ_by_chance_do_not_agree():
    generator = torch.Generator().manual_seed(0)
    noisy = [DepthMap(2 + 8 * torch.rand(HEIGHT, WIDTH, generator=generator), torch.ones(HEIGHT, WIDTH), EVERYWHERE)]
    assert not agreed([*noisy, wall(DEPTH)], [EVERYWHERE, EVERYWHERE]).any()


@pytest.mark.parametrize("confirming", [1, 2])
def test_a_small_piece_before_its_surroundings_needs_two_other_views(confirming, monkeypatch):
    monkeypatch.setattr(agreement, "MIN_PIECE", 2 * SQUARE**2 / EVERYWHERE.numel())
    monkeypatch.setattr(agreement, "AROUND", 3 * SQUARE / WIDTH)
    beside = cameras(np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [-0.4, 0.0, 0.0]]), turn=0.0, size=(WIDTH, HEIGHT))
    maps = [wall(DEPTH) for _ in range(3)]
    for view, shift in enumerate([0, -7, 7][: 1 + confirming]):  # at half the depth twice as far
        left = 17 + shift
        maps[view].depths[12 : 12 + SQUARE, left : left + SQUARE] = DEPTH / 2
    kept = consistent_pixels(to(beside, "cpu", torch.float64), maps, 3 * [EVERYWHERE], 0)
    inside = kept[13 : 11 + SQUARE, 18 : 16 + SQUARE]
    assert bool(inside.any()) == bool(inside.all()) == (confirming == 2)
    assert bool(kept[:8, 8:-8].all())  # the wall


def test_small_pieces_at_the_depths_around_them_stay(monkeypatch):
    monkeypatch.setattr(agreement, "MIN_PIECE", 2 * SQUARE**2 / EVERYWHERE.numel())
    monkeypatch.setattr(agreement, "AROUND", 0.5)
    certain = torch.zeros_like(EVERYWHERE)
    certain[:10] = True
    certain[14 : 14 + SQUARE, 20 : 20 + SQUARE] = True
    depths = torch.ones(HEIGHT, WIDTH) * DEPTH
    depths[:, 30:] = 3 * DEPTH  # a large piece
    assert not agreement._strays(depths, certain).any()
    depths[14:] = DEPTH / 2
    assert torch.equal(agreement._strays(depths, certain), certain & (torch.arange(HEIGHT) >= 14)[:, None])


@pytest.mark.parametrize(("share", "hides"), [(0.7, True), (0.96, True), (0.98, False), (1.3, False)])
def test_depths_before_an_agreed_surface_are_found(share, hides):
    agreed = torch.zeros_like(EVERYWHERE)
    agreed[10:20, 5:30] = True
    depths = torch.full((HEIGHT, WIDTH), share * DEPTH, dtype=torch.float64)
    depths[15] = 0.0  # none
    before = before_surfaces(GEOMETRY, [wall(DEPTH), wall(DEPTH)], [EVERYWHERE, agreed], depths, 0)
    rows, columns = before.nonzero().unbind(1)
    assert before.any() == hides
    if hides:
        pixels = [row for row in range(10, 20) if row != 15]
        assert rows.unique().tolist() == pixels
        shift = round(3.5 / share)
        assert len(rows) == 25 * len(pixels)
        assert abs(int(columns.min()) - 5 - shift) <= 1
