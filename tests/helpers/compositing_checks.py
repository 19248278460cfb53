"""What tests of compositing have in common."""

import dataclasses

import factories
import torch
from factories import random_camera, random_gaussians, staged
from oracles import near_threshold
from targets import TORCH

from kgs import RasterOptions, composite, project

TH, STOP = 1 / 255, 1e-4
EXACT = RasterOptions(alpha_threshold=0.0, transmittance_stop=0.0)
DTYPES = [torch.float32, torch.float64]


def drawn(n=300, size=(40, 56)):
    """Projected Gaussians, and what they are projected from."""
    gaussians = random_gaussians(n, 1, torch.float32, None, max(size), (0.05, 1.3))
    camera = random_camera(*size, 1, torch.float32)
    with torch.no_grad():
        return project(gaussians, camera, options=RasterOptions(alpha_threshold=0.0)), gaussians, camera


def footprints(opacities, centres=None, factors=None, depths=None, size=(3, 4), dtype=torch.float64, eps2d=0.0):
    """Hand-made projected Gaussians, front to back; without `factors` so wide that alpha is the same everywhere."""
    opacities = torch.as_tensor(opacities, dtype=dtype)
    wide = torch.eye(2, 3, dtype=dtype).mul(1e9).expand(len(opacities), 2, 3)
    factors = wide if factors is None else torch.as_tensor(factors, dtype=dtype)
    centres = torch.zeros(len(opacities), 2) if centres is None else torch.as_tensor(centres, dtype=dtype)
    changes = {} if depths is None else {"depths": torch.as_tensor(depths, dtype=dtype)}
    return factories.footprints(centres.to(dtype), factors, opacities, size, eps2d, **changes)


def leaves(projected, features):
    """The same footprints with leaves for inputs."""
    names = ("means2d", "factors", "opacities")
    inputs = [getattr(projected, name).detach().clone().requires_grad_() for name in names]
    inputs.append(features.detach().clone().requires_grad_())
    return dataclasses.replace(projected, **dict(zip(names, inputs[:3], strict=True))), inputs


def scene_footprints(n, seed, dtype, size=(40, 56), **kwargs):
    """Footprints and colours of an ordinary scene, and two fixed weights for a loss."""
    with torch.no_grad():
        projected = project(
            random_gaussians(n, seed, dtype, **kwargs),
            random_camera(*size, seed, dtype),
            options=RasterOptions(alpha_threshold=0.0),
        )
    generator = torch.Generator().manual_seed(seed)
    weights = torch.randn(1, 4, *size, generator=generator, dtype=torch.float64).to(dtype)
    return projected, projected.colors, weights


# -- kernels against torch -------------------------------------------------------------------------------------------

THRESHOLDS = [(TH, STOP), (0.0, 0.0), (TH, 0.1)]


def sample(n=300, size=(40, 56), thresholds=THRESHOLDS[0]):
    """Projected Gaussians, and where float32 cannot change a decision."""
    projected, gaussians, camera = drawn(n, size)
    return projected, ~near_threshold(gaussians, camera, *thresholds)


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def outcome(projected, features, certain=None, target=TORCH, dtype=torch.float32, wanted=(True,) * 4, **options):
    """Sums, light, median depth and the gradients of a loss over the pixels that are certain, all on the CPU."""
    projected, inputs = leaves(target.move(projected, dtype), target.move(features, dtype))
    for x, needed in zip(inputs, wanted, strict=True):
        x.requires_grad_(needed)
    given = {"backend": target.backend, "median_depth": True} | staged(**options)
    out = composite(projected, inputs[-1], **given)
    image = torch.cat([out.features, out.transmittance], 1)
    weights = random(*image.shape) * (1 if certain is None else certain)
    loss = (image * weights.to(image)).sum()
    gradients = torch.autograd.grad(loss, [x for x in inputs if x.requires_grad])
    images = (out.features, out.transmittance, out.median_depth)
    return [x.detach().cpu() for x in images], [x.cpu() for x in gradients]


def exact(projected, features, certain=None, **options):
    """What torch says in float64."""
    return outcome(projected, features, certain, dtype=torch.float64, **options)


def assert_close(got, expected, certain=None, bound=1e-5, image_bound=2e-6):
    certain = torch.ones(()) if certain is None else certain
    (*images, median), (*expected_images, expected_median) = got[0], expected[0]
    for a, b in zip(images, expected_images, strict=True):
        assert a.shape == b.shape
        assert ((a - b).abs() * certain).max() <= image_bound if a.numel() else True
    equal = ((median - expected_median).abs() <= 1e-5) | ~certain.bool()
    assert equal.float().mean() >= 1 - 1e-3  # T may be near one half
    for a, b in zip(got[1], expected[1], strict=True):
        assert (a - b).abs().max() <= bound * b.abs().max() if a.numel() else True
