"""Compositing against closed forms, and median depth."""

import pytest
import torch
from compositing_checks import DTYPES, EXACT, STOP, TH, footprints, leaves

from kgs import RasterOptions, composite

pytestmark = pytest.mark.usefixtures("each_backend")


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 3e-6), (torch.float64, 1e-13)])
def test_anisotropic_footprints_are_the_explicit_quadratic_form(dtype, bound):
    generator = torch.Generator().manual_seed(0)
    factors = 3 * torch.randn(20, 2, 3, generator=generator, dtype=torch.float64)
    centres = 40 * torch.rand(20, 2, generator=generator, dtype=torch.float64)
    pixels = torch.cartesian_prod(torch.arange(37), torch.arange(43)).flip(1).double()
    for factor, centre in zip(factors.to(dtype), centres.to(dtype), strict=True):
        alone = footprints([0.7], centre[None], factor[None], size=(37, 43), dtype=dtype, eps2d=0.3)
        got = composite(alone, alone.colors, options=EXACT).transmittance
        inverse = torch.linalg.inv(factor.double() @ factor.double().T + 0.3 * torch.eye(2, dtype=torch.float64))
        d = pixels - centre.double()
        expected = 1 - 0.7 * torch.exp(-0.5 * torch.einsum("pi,ij,pj->p", d, inverse, d))
        assert (got.reshape(-1) - expected).abs().max() <= bound


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n", [1, 7, 8, 9, 40])
def test_equal_layers_are_a_geometric_series_and_weights_partition_unity(dtype, n):
    color = torch.tensor([0.3, 0.6, 0.9], dtype=dtype)
    out = composite(
        footprints([0.1] * n, dtype=dtype), color.expand(n, 3), options=RasterOptions(transmittance_stop=0.0)
    )
    assert (out.transmittance - 0.9**n).abs().max() <= 1e-6
    # sum of weights and transmittance is 1, to 4 eps a layer
    total = out.features + out.transmittance * color[:, None, None]
    assert (total - color[:, None, None]).abs().max() <= 4 * n * torch.finfo(dtype).eps


def test_median_depth_is_where_less_than_half_the_light_remains():
    def median(opacities, depths):
        layers = footprints(opacities, depths=depths)
        return composite(layers, layers.colors, median_depth=True, chunk_size=2).median_depth

    assert (median([0.3, 0.3, 0.3, 0.9], [1.0, 2.0, 3.0, 4.0]) == 2).all()  # T: .7, .49
    assert (median([0.25, 0.25, 0.25, 0.9], [1.0, 2.0, 3.0, 4.0]) == 3).all()  # T: .75, .5625, .42
    assert (median([0.9, 0.3, 0.3], [5.0, 2.0, 3.0]) == 3).all()  # sorted by depth
    assert (median([0.1, 0.1], [1.0, 2.0]) == 0).all()
    assert (median([0.5], [1.0]) == 0).all()  # exactly half is not less than half
    assert (median([], []) == 0).all()


def test_median_depth_is_only_made_when_asked_for_and_has_no_gradient():
    projected, inputs = leaves(footprints([0.6, 0.6]), torch.ones(2, 3).double())
    assert composite(projected, inputs[-1]).median_depth is None
    found = composite(projected, inputs[-1], median_depth=True).median_depth
    assert found.shape == (1, 1, 3, 4)
    assert not found.requires_grad


# -- rules -----------------------------------------------------------------------------------------------------------


def test_stop_is_inclusive():
    # T behind two layers of 0.99 is 9.99998e-5 in float32 and 1.0000000000000002e-4 in float64: both must count them
    white = {}
    for dtype in DTYPES:
        out = composite(footprints([0.99, 0.99], dtype=dtype), torch.eye(2, 3, dtype=dtype))
        assert (out.features[0, :2, 0, 0].double() - torch.tensor([0.99, 0.0099])).abs().max() <= 1e-6
        white[dtype] = (out.features[:, :2].sum(1) + out.transmittance[:, 0]).double()
    assert (white[torch.float32] - white[torch.float64]).abs().max() <= STOP + 1e-6


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("stop", [0.02, 0.05, 0.5])
def test_light_of_exactly_the_stop_is_the_border(stop, dtype):
    exact = [(stop, True)] if stop == 0.5 else []  # the others are rounded
    for left, counts in [(stop * (1 - 1e-4), False), (stop * (1 + 1e-4), True), *exact]:
        out = composite(
            footprints([1 - left, 0.5], dtype=dtype),
            torch.eye(2, dtype=dtype),
            options=RasterOptions(transmittance_stop=stop),
        )
        assert (out.features[0, 1] - 0.5 * left * counts).abs().max() <= 1e-6
        assert not out.transmittance.any()


def test_a_layer_counts_from_the_threshold_on():
    for opacity, drawn in ((TH * (1 - 1e-5), False), (TH * (1 + 1e-5), True)):
        layer = footprints([opacity], dtype=torch.float32)
        assert bool((composite(layer, layer.colors).transmittance < 1).all()) is drawn


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("opacity", [0.98, 0.995, 1.3])
def test_clamp_of_alpha_and_its_exact_gradient(opacity, dtype):
    alpha, slope = min(opacity, 0.99), float(opacity < 0.99)
    projected, inputs = leaves(footprints([opacity, 0.5], dtype=dtype), torch.tensor([[1.0], [3.0]], dtype=dtype))
    out = composite(projected, inputs[-1])
    assert (out.features - (alpha + 3 * 0.5 * (1 - alpha))).abs().max() <= 1e-6
    (out.features.sum() + 7 * out.transmittance.sum()).backward()
    pixels = 12
    # d/da of  a + 3 (1 - a) / 2 + 7 (1 - a) / 2,  and of the layer behind
    expected = [slope * pixels * (1 - 1.5 - 3.5), pixels * (1 - alpha) * (3 - 7)]
    assert (inputs[2].grad - torch.tensor(expected, dtype=dtype)).abs().max() <= 1e-4
    assert (inputs[3].grad[:, 0] - torch.tensor([alpha, 0.5 * (1 - alpha)]) * pixels).abs().max() <= 1e-5
