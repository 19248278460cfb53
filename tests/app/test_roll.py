"""Pictures that are turned, where photos lie on their side."""

from __future__ import annotations

import pytest
import torch
from factories import pinhole, random_gaussians

import kgs
from kgs.app.files.cameras import rolled
from kgs.datasets.scene import Views

SIZE = (12, 20)


def views() -> Views:
    camera = pinhole(*SIZE, 20.0, (9.0, 6.5))
    images = torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Views(camera, images, ("a.jpg",), images[:, :1], images[0, 0])


@pytest.mark.parametrize(("degrees", "quarters"), [(90, 1), (180, 2), (-90, 3), (270, 3), (360, 0)])
def test_a_quarter_turn_of_the_cameras_turns_the_render_clockwise(degrees: float, quarters: int) -> None:
    straight = views()
    turned = rolled(straight, degrees)
    gaussians = random_gaussians(30, 0, torch.float64, image_size=max(SIZE))
    renderer = kgs.GaussianRenderer(backend="torch").eval()
    render, render_turned = (renderer(gaussians, each.cameras).image for each in (straight, turned))
    expected = torch.rot90(render, -quarters, (-2, -1))
    torch.testing.assert_close(render_turned, expected, rtol=0, atol=1e-10)
    assert torch.equal(turned.images, torch.rot90(straight.images, -quarters, (-2, -1)))
    assert turned.alphas is not None
    assert torch.equal(turned.alphas, turned.images[:, :1])
    assert turned.border_mask is not None
    assert torch.equal(turned.border_mask, turned.images[0, 0])


def test_a_small_angle_tilts_the_scene_within_the_frame() -> None:
    straight = views()
    assert rolled(straight, 0.0) is straight
    turned = rolled(straight, 10.0)
    assert turned.images.shape == straight.images.shape
    point = torch.tensor([[0.3, 0.1, 4.0]], dtype=torch.float64)

    def from_centre(each: Views) -> torch.Tensor:
        pixel = each.cameras.project(point)[0]
        return pixel - each.cameras.intrinsics[0, :2, 2]

    angles = [torch.atan2(y, x) for x, y in (from_centre(straight), from_centre(turned))]  # y points down: clockwise
    assert float((angles[1] - angles[0]).rad2deg()) == pytest.approx(10, abs=1e-6)
