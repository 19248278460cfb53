"""What first order costs: the footprint of a Gaussian against the exact moments of its perspective projection.

Source: M. Zwicker et al., "EWA Volume Splatting", 2001, whose linearisation is measured here.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from kgs import Gaussians, RasterOptions, project
from kgs.bench.scenes import centred_camera

SIGMAS, ANGLES = (1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.2, 0.3), (0, 20, 40, 55)
NODES = 5  # the outermost lies 2.9 sigma out: in front of the camera for all of SIGMAS


def moments(centre: Tensor, sigma: float, nodes: int) -> tuple[Tensor, Tensor]:
    """Mean `(2,)` and covariance `(2, 2)` of (x / z, y / z), (x, y, z) normal, by Gauss-Hermite quadrature."""
    knots, weights = (torch.from_numpy(a) for a in np.polynomial.hermite_e.hermegauss(nodes))
    points = centre + sigma * torch.cartesian_prod(knots, knots, knots)
    share = torch.cartesian_prod(weights, weights, weights).prod(1) / weights.sum() ** 3
    plane = points[:, :2] / points[:, 2:]
    mean = share @ plane
    return mean, (share[:, None] * (plane - mean)).mT @ (plane - mean)


@pytest.fixture(scope="module")
def errors() -> list[dict[str, float]]:
    """First-order moments against exact ones, one row per angle off axis and sigma / z."""
    cases = [(angle, sigma) for angle in ANGLES for sigma in SIGMAS]
    n, size, focal = len(cases), 2048, 512.0
    centres = torch.tensor([[math.tan(math.radians(angle)), 0, 1] for angle, _ in cases], dtype=torch.float64)
    scales = torch.tensor([[sigma] * 3 for _, sigma in cases], dtype=torch.float64)
    quats, ones = torch.eye(4).double()[:1].expand(n, 4), torch.ones(n, 3).double()
    drawn = project(
        Gaussians(centres, quats, scales, ones[:, 0], ones),
        centred_camera((size, size), focal),
        options=RasterOptions(eps2d=0.0),
    )
    rows = []
    for k, (angle, sigma) in enumerate(cases):
        first_order = drawn.factors[k] @ drawn.factors[k].mT / focal**2
        mean, exact = moments(centres[k], sigma, NODES)
        shift = mean - (drawn.means2d[k] - (size - 1) / 2) / focal
        error = float((exact - first_order).norm() / exact.norm())
        _, coarse = moments(centres[k], sigma, NODES - 1)
        row = {"angle": angle, "sigma_over_z": sigma, "covariance_error": error}
        row["mean_error_sigmas"] = float((shift @ torch.linalg.inv(first_order) @ shift).sqrt())
        rows.append({**row, "quadrature_change": abs(float((coarse - first_order).norm() / coarse.norm()) / error - 1)})
    return rows


def test_the_first_order_footprint_errs_with_the_square_of_its_angle(
    errors: list[dict[str, float]], record_property: Callable[[str, object], None]
) -> None:
    for row in errors:
        record_property("projection", row)
    rows = [row for row in errors if row["sigma_over_z"] <= 0.1]
    for angle in ANGLES:
        of = [row for row in rows if row["angle"] == angle]
        x = np.log([row["sigma_over_z"] for row in of])
        assert np.polyfit(x, np.log([row["covariance_error"] for row in of]), 1)[0] == pytest.approx(2, abs=0.1)
        if angle:
            assert np.polyfit(x, np.log([row["mean_error_sigmas"] for row in of]), 1)[0] == pytest.approx(1, abs=0.1)
    assert max(row["quadrature_change"] for row in rows) < 1e-2


@pytest.mark.parametrize("sigma", [1e-3, 1e-2, 0.1])
def test_the_moments_on_the_axis_are_those_of_the_series(sigma: float) -> None:
    # on the axis E[(x / z)^2] = sigma^2 E[z^-2], E[z^-2] = 1 + 3 sigma^2 + 15 sigma^4 + 105 sigma^6 + ...
    _, covariance = moments(torch.tensor([0.0, 0.0, 1.0]).double(), sigma, NODES)
    series = sum(math.prod(range(1, 2 * k + 2, 2)) * sigma ** (2 * k) for k in range(5))
    assert float(covariance[0, 0]) == pytest.approx(sigma**2 * series, rel=1e-5)
    assert float(covariance[0, 1]) == pytest.approx(0, abs=1e-18)
