"""Views: halved pictures keep showing the same rays."""

import pytest
import torch
from kornia.geometry.camera import PinholeCamera

from kgs.datasets.scene import Views


def views(height, width):
    intrinsics = torch.eye(4).repeat(2, 1, 1)
    intrinsics[:, 0, 0], intrinsics[:, 1, 1] = 30.0, 31.0
    intrinsics[:, 0, 2], intrinsics[:, 1, 2] = 9.3, 7.1
    extrinsics = torch.eye(4).repeat(2, 1, 1)
    extrinsics[:, 2, 3] = 1.0
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    images = torch.stack([rows, columns, rows + columns]).float().expand(2, 3, height, width) / 100
    sizes = (torch.full((2,), float(size)) for size in (height, width))
    return Views(PinholeCamera(intrinsics, extrinsics, *sizes), images, ("a", "b"), torch.ones(2, 1, height, width))


@pytest.mark.parametrize("size", [(16, 20), (15, 21)])
def test_a_point_projects_to_the_same_place_of_a_halved_picture(size):
    full = views(*size)
    half = full.halved()
    assert half.images.shape == (2, 3, size[0] // 2, size[1] // 2)
    assert half.masks.shape == (2, 1, size[0] // 2, size[1] // 2)
    points = torch.tensor([[[0.1, -0.2, 3.0]], [[-0.3, 0.1, 2.0]]])
    on_full, on_half = full.cameras.project(points), half.cameras.project(points)
    # pixel k of the halved picture covers pixels 2k and 2k + 1, whose middle is 2k + 1/2
    assert torch.allclose(on_full, 2 * on_half + 0.5, atol=1e-5)
    # the picture is a ramp in its own coordinates, and so is the halved one
    assert torch.allclose(half.images[0, 1, 0, 3], torch.tensor(6.5 / 100))


def test_a_single_row_cannot_be_halved():
    with pytest.raises(ValueError, match="2 x 2"):
        views(1, 8).halved()
