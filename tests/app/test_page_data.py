"""The splat of a page, decoded by the description of its layout alone, against the exact values."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
import pytest
import torch
from factories import batch, random_camera, random_gaussians, replace

import kgs
from kgs import Gaussians
from kgs.app.page.data import PIXEL_ERROR, Packed, pack

SIZE = (90, 120)


@pytest.fixture(scope="module")
def cameras() -> Any:
    return batch(*(random_camera(*SIZE, seed) for seed in range(2)))


def decode(packed: Packed) -> dict[str, Any]:
    """Columns by their names, as a viewer reads them."""
    planes, count, start = np.frombuffer(gzip.decompress(packed.content), np.uint8), packed.layout["count"], 0
    columns = {}
    for name, width, low, step in packed.layout["columns"]:
        whole = planes[start : start + width * count].reshape(width, count).astype(float)
        columns[name] = low + step * (256.0 ** np.arange(width - 1, -1, -1) @ whole)
        start += width * count
    assert start == len(planes)
    return columns


def gaussians_of(packed: Packed) -> Gaussians:
    """What a viewer draws."""
    columns, degree = decode(packed), packed.layout["degree"]
    means = np.stack([columns[axis] for axis in "xyz"], 1)
    three = np.stack([columns[f"quat{axis}"] for axis in range(3)], 1)
    pairs = zip(three, columns["largest"].astype(int), strict=True)
    quats = np.array([np.insert(row, index, np.sqrt(max(0.0, 1 - row @ row))) for row, index in pairs]).reshape(-1, 4)
    scales = np.exp(np.stack([columns[f"scale{axis}"] for axis in range(3)], 1))
    stored = np.stack([[columns[f"sh{k}{c}"] for c in "rgb"] for k in range((degree + 1) ** 2)])
    colors = (stored * np.abs(stored)).transpose(2, 0, 1)
    return Gaussians(*map(torch.from_numpy, (means, quats, scales, columns["opacity"], colors)))


def nearest(of: Gaussians, among: Gaussians) -> Any:
    """For each Gaussian the row of the one with the nearest centre: the page has an order of its own."""
    return torch.cdist(of.means, among.means).argmin(1)


def test_values_come_back_within_their_bounds(cameras: Any) -> None:
    exact = random_gaussians(300, 0, sh_degree=3)
    shown = gaussians_of(pack(exact, cameras, 10**7))
    assert len(shown) == 300
    exact = exact[nearest(shown, exact)]
    assert largest_shift(exact, shown, cameras) < PIXEL_ERROR
    assert ((shown.scales / exact.scales).log().abs()).max() < 1e-4
    assert (shown.opacities - exact.opacities).abs().max() < 1e-5
    turned = (torch.nn.functional.normalize(exact.quats) * shown.quats).sum(1).abs()
    assert turned.clamp(max=1).acos().max() < 1e-3
    assert (shown.colors - exact.colors)[:, 0].abs().max() < 1e-4
    assert (shown.colors - exact.colors)[:, 1:].abs().max() < 0.01 * exact.colors[:, 1:].abs().max()


def test_what_no_picture_shows_is_left_out(cameras: Any) -> None:
    exact = random_gaussians(50, 1, sh_degree=0)
    opacities, means = exact.opacities.clone(), exact.means.clone()
    opacities[:5], means[7, 1] = 0.003, torch.nan
    assert len(gaussians_of(pack(replace(exact, opacities=opacities, means=means), cameras, 10**7))) == 44


@pytest.mark.parametrize("distances", [(1e8,), (2e7, -2e7), (1e12,), (3e5,)])
def test_strays_move_nothing_else(cameras: Any, distances: tuple[float, ...]) -> None:
    """Beside all cameras, and before them; the last one is too near to be a stray, and is kept."""
    exact = random_gaussians(300, 0, sh_degree=0)
    means = exact.means.clone()
    for i, distance in enumerate(distances):
        means[i] = torch.tensor([0.3, 0.2, 1.0]).double() * distance
    exact = replace(exact, means=means)
    packed = pack(exact, cameras, 10**7)
    shown = gaussians_of(packed)
    gone = 0 if max(distances) < 1e6 else len(distances)
    assert len(shown) == 300 - gone
    assert packed.reduced == ["", "all but 1 stray Gaussian", "all but 2 stray Gaussians"][gone]
    rest = exact[torch.arange(len(distances), 300)]
    found = shown[nearest(rest, shown)]
    assert largest_shift(rest, found, cameras) < PIXEL_ERROR


def largest_shift(exact: Gaussians, shown: Gaussians, cameras: Any) -> float:
    """Of the centres in the pictures that show them, in pixels."""
    maximum = 0.0
    for extrinsics, k in zip(cameras.extrinsics, cameras.intrinsics, strict=True):
        pixels = []
        for each in (exact, shown):
            points = each.means @ extrinsics[:3, :3].T + extrinsics[:3, 3]
            pixels.append(points[:, :2] / points[:, 2:] * k[[0, 1], [0, 1]] + k[:2, 2])
        inside = (pixels[0] > 0).all(1) & (pixels[0] < torch.tensor(SIZE[::-1])).all(1)
        maximum = max(maximum, float((pixels[1] - pixels[0])[inside].norm(dim=1).max()))
    return maximum


@pytest.mark.parametrize("name", ["colors", "scales"])
def test_one_huge_value_costs_the_others_nothing(cameras: Any, name: str) -> None:
    """Of a Gaussian that is hidden beside the frame: the pictures stay."""
    plain = random_gaussians(300, 0, sh_degree=3)
    means = plain.means.clone()
    means[0] = torch.tensor([0.0, 0.0, -4.0]).double()  # behind both cameras
    plain = replace(plain, means=means)
    values = getattr(plain, name).clone()
    values[0].view(-1)[-1] = 1e8 if name == "colors" else 1e-300
    huge = replace(plain, **{name: values})
    render = kgs.GaussianRenderer(backend="torch").eval()
    with torch.no_grad():
        images = [
            render(each, cameras).image
            for each in (plain, *(gaussians_of(pack(g, cameras, 10**7)) for g in (plain, huge)))
        ]
    errors = [float((image - images[0]).square().mean().sqrt()) for image in images[1:]]
    assert errors[1] < 1.5 * errors[0]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_gaussians_and_degenerate_ones(cameras: Any, count: int) -> None:
    exact = random_gaussians(count, 2, sh_degree=1)
    exact = replace(exact, scales=torch.zeros_like(exact.scales), quats=torch.zeros_like(exact.quats))
    shown = gaussians_of(pack(exact, cameras, 10**7))
    assert len(shown) == count
    assert all(bool(value.isfinite().all()) for value in vars(shown).values())


def test_a_limit_costs_bits_then_harmonics_then_the_least_gaussians(cameras: Any) -> None:
    exact = random_gaussians(400, 3, sh_degree=2)
    whole = pack(exact, cameras, 10**7)
    assert whole.reduced == ""
    sizes, words = [], []
    for maximum in (len(whole.content) - 1, len(whole.content) // 2, 3000):
        packed = pack(exact, cameras, maximum, lambda: torch.arange(400.0))
        sizes.append(len(packed.content))
        words.append(packed.reduced)
        assert sizes[-1] <= maximum
    assert words[0] == "8-bit numbers"
    assert words[1].startswith("8-bit numbers, harmonics up to degree ")
    assert words[2].endswith("of 400 Gaussians")
    kept = nearest(gaussians_of(packed), exact)
    assert kept.min() == 400 - len(kept)  # those that contribute most
    with pytest.raises(ValueError, match="expected room for a Gaussian, got 20 bytes"):
        pack(exact, cameras, 20)


def test_a_coarse_splat_still_looks_the_same(cameras: Any) -> None:
    exact = random_gaussians(300, 4, sh_degree=3)
    fine = pack(exact, cameras, 10**7)
    coarse = pack(exact, cameras, len(fine.content) - 1)
    render = kgs.GaussianRenderer(backend="torch").eval()
    with torch.no_grad():
        images = [render(each, cameras).image for each in (exact, *map(gaussians_of, (fine, coarse)))]
    errors = [float((image - images[0]).square().mean().sqrt()) for image in images[1:]]
    assert errors[0] < 0.002
    assert errors[1] < 0.02
