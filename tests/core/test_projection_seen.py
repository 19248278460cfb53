"""What `project` lists: what can be seen, and nothing that is not finite."""

import math

import pytest
import torch
from factories import pinhole, random_camera, random_gaussians, replace
from projection_checks import HEIGHT, WIDTH, sigma_route

from kgs import Gaussians, RasterOptions, project

pytestmark = pytest.mark.usefixtures("each_backend")


def wide_scene(dtype=torch.float64):
    """Gaussians in, partly in and far outside the image, before and behind the camera, faint and dense."""
    gaussians = random_gaussians(600, 3, dtype, 0, WIDTH, opacities=(0.0, 1.0))
    means = gaussians.means * torch.tensor([3.0, 3.0, 1.0], dtype=dtype)
    means[::5, 2] *= -1
    return replace(gaussians, means=means)


REACH = math.sqrt(2 * math.log(2 * 255))  # standard deviations within which a footprint of opacity 2 is drawn


def test_the_list_is_everything_in_front_that_would_be_drawn_at_opacity_two():
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    got = project(gaussians, cameras)
    pixels, sigma, depths = sigma_route(gaussians, cameras)
    reach = REACH * sigma.diagonal(dim1=1, dim2=2).sqrt()
    size = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    distance = (torch.maximum(-0.5 - pixels, pixels - size + 0.5) - reach).amax(1)  # below 0: the image is touched
    clear = distance.abs() > 0.05
    expected = (distance < 0) & (depths > 0.01)
    listed = torch.zeros(len(gaussians), dtype=torch.bool)
    listed[got.gaussian_ids] = True
    assert torch.equal(listed[clear], expected[clear])
    assert 50 < len(got) < 400
    assert clear.sum() > 580


def test_with_threshold_0_every_gaussian_in_front_is_listed():
    gaussians, cameras = wide_scene(), random_camera(HEIGHT, WIDTH, 0)
    depths = sigma_route(gaussians, cameras)[2]
    listed = project(gaussians, cameras, options=RasterOptions(alpha_threshold=0.0)).gaussian_ids
    assert torch.equal(listed, (depths > 0.01).nonzero()[:, 0])


@pytest.mark.parametrize(("beyond", "listed"), [(3.2, [True] * 5), (3.5, [True] * 5), (3.6, [False] * 4 + [True])])
def test_visibility_is_free_of_opacity(beyond, listed):
    """A dot of variance 1 beside the image: the same for every opacity up to 2; above, the list only grows."""
    mean = torch.tensor([[0.0, 0.0, 4.0]], dtype=torch.float64)
    one = Gaussians(mean, torch.eye(4)[:1].double(), torch.full((1, 3), 1e-9).double(), torch.ones(1).double(), mean)
    camera = pinhole(HEIGHT, WIDTH, 4.0, centre=(-0.5 - beyond, 24.0))
    seen = [
        len(project(replace(one, opacities=torch.tensor([opacity]).double()), camera, options=RasterOptions(eps2d=1.0)))
        == 1
        for opacity in (0.0, 0.2, 1.0, 1.25, 4.0)
    ]
    assert seen == listed
