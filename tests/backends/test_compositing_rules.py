"""The rules of compositing: thresholds, the clamp of alpha, many layers."""

import pytest
import torch
from compositing_checks import DTYPES, STOP, TH, footprints, leaves

from kgs import RasterOptions, composite

pytestmark = pytest.mark.usefixtures("each_backend")


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


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [1 / 250, 0.05])
def test_twenty_thousand_layers(alpha):
    n = 20000
    generator = torch.Generator().manual_seed(0)
    opacities = alpha * (1 + torch.rand(n, generator=generator))
    colors = torch.rand(n, 3, generator=generator)
    projected, inputs = leaves(footprints(opacities, size=(2, 2), dtype=torch.float32), colors)
    out = composite(projected, inputs[-1], options=RasterOptions(tile_size=2, transmittance_stop=0.0))
    got = torch.autograd.grad(out.features.mean((2, 3)).sum() + out.transmittance.mean(), inputs)

    a, c = (x.double().requires_grad_() for x in (opacities, colors))
    light = torch.cumprod(torch.cat([torch.ones(1), 1 - a]), 0)
    expected = ((a * light[:-1])[:, None] * c).sum(0)
    d_opacities, d_colors = torch.autograd.grad(expected.sum() + light[-1], (a, c))
    assert ((out.features[0, :, 0, 0] - expected) / expected).abs().max() <= 1e-5
    assert (out.transmittance - light[-1].detach()).abs().max() <= 1e-6
    assert all(gradient.isfinite().all() for gradient in got)
    seen = light[:-1] > 1e-6
    assert ((got[3] - d_colors) / d_colors)[seen].abs().max() <= 1e-5
    assert (got[2] - d_opacities).abs().max() <= 1e-5 * d_opacities.abs().max()
    dark = light[:-1] < 1e-46
    assert not got[2][dark].any()
    assert not got[3][dark].any()
