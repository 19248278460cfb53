"""Colours of patches of a wall, whose colour rises evenly so that interpolation is exact."""

import numpy as np
import torch
from init_point_scenes import as_views, cameras

from kgs.geometry.cameras import to
from kgs.geometry.multiview import inverse_intrinsics
from kgs.geometry.rigs import camera_centers
from kgs.init_points.patches import MIN_AGREED, patch_colors
from kgs.init_points.plane_sweep import DepthMap

WIDTH, HEIGHT, DEPTH = 40, 32, 4.0
CENTERS = np.array([[-0.2, 0.0, 0.0], [0.0, 0.1, 0.0], [0.2, 0.0, 0.0], [0.4, 0.1, 0.0]])
POSED = cameras(CENTERS, turn=0.05, size=(WIDTH, HEIGHT))
GEOMETRY = to(POSED, "cpu", torch.float64)
EVERYWHERE = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
PIXELS = torch.cartesian_prod(torch.arange(WIDTH), torch.arange(HEIGHT))
TINTS = torch.tensor([0.0, 0.1, 0.2, 0.3])  # each camera sees the wall in another colour


def walls():
    """The depths of the wall z = DEPTH in each view, and images of it."""
    rays = torch.cat([PIXELS.double(), torch.ones(len(PIXELS), 1)], 1) @ inverse_intrinsics(GEOMETRY).mT
    world = rays @ GEOMETRY.extrinsics[:, :3, :3]
    depths = (DEPTH - camera_centers(GEOMETRY.extrinsics)[:, None, 2:]) / world[..., 2:]
    points = camera_centers(GEOMETRY.extrinsics)[:, None] + depths * world
    colors = 0.3 + 0.02 * points[..., [0, 1, 0]] + TINTS[:, None, None]

    def as_images(values):
        return values.mT.reshape(4, -1, WIDTH, HEIGHT).mT.float()

    scores = torch.ones(HEIGHT, WIDTH)
    return [DepthMap(depth, scores, EVERYWHERE) for depth in as_images(depths)[:, 0]], as_images(colors)


def patches_of(certain):
    maps, images = walls()
    return patch_colors(as_views(POSED, images), GEOMETRY, maps, certain, [mask.nonzero().flip(1) for mask in certain])


def test_patches_have_the_colours_and_directions_of_the_wall():
    patches = patches_of([EVERYWHERE] * 4)
    assert len(patches) > 4 * 10
    plain = torch.where(patches.visible[..., None], patches.colors - TINTS[:, None], 0.0)
    means = plain.sum(1, keepdim=True) / patches.visible.sum(1)[:, None, None]
    torch.testing.assert_close(plain[patches.visible], means.expand_as(plain)[patches.visible], atol=2e-4, rtol=0)
    to_wall = (DEPTH - camera_centers(GEOMETRY.extrinsics)[:, 2]) / patches.directions[..., 2]
    points = camera_centers(GEOMETRY.extrinsics) + to_wall[..., None] * patches.directions
    torch.testing.assert_close(points, points[:, :1].expand_as(points), atol=1e-5, rtol=0)
    torch.testing.assert_close(means[:, 0, :2], (0.3 + 0.02 * points[:, 0, :2]).float(), atol=2e-4, rtol=0)


def test_only_views_that_agree_show_a_patch():
    nowhere = torch.zeros_like(EVERYWHERE)
    assert len(patches_of([EVERYWHERE, EVERYWHERE, nowhere, nowhere])) == 0
    three = patches_of([EVERYWHERE, EVERYWHERE, EVERYWHERE, nowhere])
    assert len(three) > 10
    assert torch.equal(three.visible, torch.tensor([True, True, True, False]).expand_as(three.visible))
    few = nowhere.clone()
    few[: 2 * MIN_AGREED - 2 : 2, 0] = True  # one pixel too few of those that are looked up
    assert len(patches_of([few, EVERYWHERE, EVERYWHERE, EVERYWHERE])) == len(
        patches_of([nowhere, EVERYWHERE, EVERYWHERE, EVERYWHERE])
    )
