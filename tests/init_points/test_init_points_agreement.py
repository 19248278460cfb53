"""Depth maps of a wall seen by two cameras side by side: which depths are averaged, and which pixels are kept."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from init_point_scenes import cameras

from kgs.geometry import ViewGeometry
from kgs.init_points.agreement import agreed_points, average_depths
from kgs.init_points.plane_sweep import DepthMap

WIDTH, HEIGHT, DEPTH = 40, 30, 4.0
BESIDE = cameras(np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]]), turn=0.0, size=(WIDTH, HEIGHT))
GEOMETRY = ViewGeometry.of(BESIDE)
EVERYWHERE = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
SHARED = (slice(None), slice(5, None))  # of the first view: the second camera sees it 3.5 pixels further left


def wall(depth: float) -> DepthMap:
    return DepthMap(torch.full((HEIGHT, WIDTH), depth), torch.ones(HEIGHT, WIDTH), EVERYWHERE)


def agreed(maps: list[DepthMap], certain: list[torch.Tensor]) -> torch.Tensor:
    """Which pixels of the first view are kept."""
    _, pixels = agreed_points(GEOMETRY, maps, certain, 0)
    kept = torch.zeros_like(EVERYWHERE)
    kept[pixels[:, 1], pixels[:, 0]] = True
    return kept


def test_similar_depths_are_averaged_and_agree_then() -> None:
    maps, certain = [wall(DEPTH), wall(1.025 * DEPTH)], [EVERYWHERE, EVERYWHERE]
    averaged = average_depths(GEOMETRY, maps, certain)
    expected = torch.tensor(2 / (1 / DEPTH + 1 / (1.025 * DEPTH)))
    torch.testing.assert_close(averaged[0].depths[SHARED], expected.expand(HEIGHT, WIDTH - 5))
    torch.testing.assert_close(averaged[1].depths[:, : WIDTH - 5], expected.expand(HEIGHT, WIDTH - 5))
    assert torch.equal(averaged[0].depths[:, :3], maps[0].depths[:, :3])  # outside the other image
    assert bool(agreed(averaged, certain)[SHARED].all())


@pytest.mark.parametrize("unlike", ["depth", "own mask", "other mask"])
def test_other_depths_stay(unlike: str) -> None:
    maps = [wall(DEPTH), wall((1.05 if unlike == "depth" else 1.02) * DEPTH)]
    masks = [EVERYWHERE & (unlike != "own mask"), EVERYWHERE & (unlike != "other mask")]
    assert torch.equal(average_depths(GEOMETRY, maps, masks)[0].depths, maps[0].depths)


def test_pixels_need_agreeing_neighbours() -> None:
    certain = torch.zeros_like(EVERYWHERE)
    certain[12:14, 14:16] = True  # alone
    certain[:, 20:] = True  # up to a straight edge
    kept = agreed([wall(DEPTH), wall(DEPTH)], [certain, EVERYWHERE])
    assert not kept[:, :20].any()
    assert bool(kept[:, 20:].all())


def test_depths_that_differ_by_chance_do_not_agree() -> None:
    generator = torch.Generator().manual_seed(0)
    noisy = [DepthMap(2 + 8 * torch.rand(HEIGHT, WIDTH, generator=generator), torch.ones(HEIGHT, WIDTH), EVERYWHERE)]
    assert not agreed([*noisy, wall(DEPTH)], [EVERYWHERE, EVERYWHERE]).any()
