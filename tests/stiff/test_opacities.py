"""Opacities above 1."""

import dataclasses

import pytest
import torch
from factories import pinhole, random_camera, random_gaussians
from oracles import enumerate_drops
from stiff_checks import one

from kgs import GaussianRenderer

pytestmark = pytest.mark.usefixtures("each_backend")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("tile_size", [4, 16])
def test_an_opacity_above_one_is_drawn_to_where_its_own_alpha_ends(tile_size, dtype):
    # 1.25, as DropGaussian makes it at a rate of 0.2: alpha reaches 1/255 at 3.395 sigma, beyond the 3.33 of opacity 1
    camera = pinhole(101, 101, (100.0, 100.0), dtype=dtype)
    gaussians = one((0.4, 0.4, 0.4), mean=(0.0, 0.0, 4.0), opacity=1.25, dtype=dtype)
    alpha = GaussianRenderer(tile_size=tile_size)(gaussians, camera, outputs=("alpha",)).alpha[0, 0].double()
    y, x = torch.meshgrid(torch.arange(101.0) - 50, torch.arange(101.0) - 50, indexing="ij")
    squared = (x * x + y * y).double() / (100 + 0.3)
    raw = 1.25 * torch.exp(-squared / 2)
    expected = torch.where(raw >= 1 / 255, raw.clamp(max=0.99), 0.0)
    certain = (raw * 255 - 1).abs() > 1e-5
    assert ((alpha - expected).abs() * certain).max() <= (2e-6 if dtype == torch.float32 else 1e-12)
    ring = (squared.sqrt() > 3.34) & (squared.sqrt() < 3.39)
    assert ring.any()
    assert (alpha[ring] > 0).all()
    assert (alpha[squared.sqrt() > 3.4] == 0).all()


def test_expectation_over_all_masks_is_the_image_while_nothing_is_clamped():
    gaussians, camera = random_gaussians(6, 2, opacities=(0.05, 0.75)), random_camera(16, 16, 2)
    renderer = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
    full = renderer(gaussians, camera, outputs=("image",)).image

    def render(factors):
        return renderer(dataclasses.replace(gaussians, opacities=gaussians.opacities * factors), camera).image

    assert (enumerate_drops(6, 0.2, render) - full).abs().max() <= 1e-14
    assert (render(torch.tensor([1, 1, 1, 1, 1, 0]).double()) - full).abs().max() > 1e-3


def test_expectation_of_a_clamped_alpha_is_known():
    # o = 0.99, rate 0.2: kept it is 1.2375, clamped to 0.99, so the mean alpha at the peak is 0.8 * 0.99
    gaussians = one((1.0, 1.0, 1.0), mean=(0.0, 0.0, 4.0), opacity=0.99, dtype=torch.float64)
    camera = pinhole(3, 3, (10.0, 10.0))

    def peak(factors):
        thinned = dataclasses.replace(gaussians, opacities=gaussians.opacities * factors)
        return GaussianRenderer()(thinned, camera, outputs=("alpha",)).alpha[0, 0, 1, 1]

    assert enumerate_drops(1, 0.2, peak).item() == pytest.approx(0.8 * 0.99, abs=1e-12)
