"""Lists of tiles against brute force: every tile with a pixel whose alpha reaches the threshold, and hardly another."""

import pytest
import torch
from factories import footprints
from tile_checks import THRESHOLD, check_structure, listed, scene

from kgs.backends.torch.binning import TileCoverage, bin_to_tiles


def needles(seed, ratio, size=(45, 67)):
    """Lines, 0.5 px thick and `ratio` times as long, at all angles."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(100, 5, generator=generator)
    along = torch.stack([torch.cos(3.2 * random[:, 0]), torch.sin(3.2 * random[:, 0])], 1)
    across = torch.stack([-along[:, 1], along[:, 0]], 1)
    factors = torch.stack([0.5 * ratio * along, 0.5 * across, torch.zeros_like(along)], 2)
    means2d = random[:, 1:3] * torch.tensor([size[1], size[0]])
    return footprints(means2d, factors, random[:, 3] * 0.9 + 0.1, size)


def strengths(projected, tile_size):
    """For each Gaussian and tile the largest alpha over the tile's pixels, and which tiles it owns; float64."""
    height, width = projected.image_size
    rows, columns = -(-height // tile_size), -(-width // tile_size)
    factors = projected.factors.double()
    inverse = torch.linalg.inv(factors @ factors.mT + projected.eps2d * torch.eye(2, dtype=torch.float64))
    alphas = torch.zeros(len(projected), rows * tile_size, columns * tile_size, dtype=torch.float64)
    dx = torch.arange(width) - projected.means2d[:, :1].double()
    dy = torch.arange(height) - projected.means2d[:, 1:].double()
    a, b, c = (value[:, None, None] for value in (inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]))
    dx, dy = dx[:, None, :], dy[:, :, None]
    exponent = (a * dx + 2 * b * dy) * dx + c * dy * dy
    alphas[:, :height, :width] = projected.opacities.double()[:, None, None] * torch.exp(-0.5 * exponent)
    largest = alphas.reshape(-1, rows, tile_size, columns, tile_size).amax((2, 4)).flatten(1)
    everywhere = torch.zeros(len(projected), projected.num_cameras, rows * columns, dtype=torch.float64)
    everywhere[torch.arange(len(projected)), projected.camera_ids] = largest
    return everywhere.flatten(1)


@pytest.mark.parametrize("tile_size", [1, 4, 8, 16, 64, 100])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("threshold", [THRESHOLD, 0.1, 1e-4])
def test_no_tile_is_missed_and_few_are_in_vain(tile_size, dtype, threshold):
    extra = total = 0
    for seed in (0, 1):
        projected = scene(seed, dtype)
        bins = bin_to_tiles(projected, tile_size, threshold)
        check_structure(projected, bins)
        got, wanted = listed(projected, bins), strengths(projected, tile_size) >= threshold
        assert not (wanted & ~got).any()
        extra, total = extra + (got & ~wanted).sum().item(), total + got.sum().item()
    assert extra < 0.03 * total


@pytest.mark.parametrize("ratio", [1, 10, 1e3, 1e5])
@pytest.mark.parametrize("tile_size", [4, 16])
def test_needles_at_all_angles(tile_size, ratio):
    projected = needles(int(ratio), ratio)
    bins = bin_to_tiles(projected, tile_size)
    check_structure(projected, bins)
    got, wanted = listed(projected, bins), strengths(projected, tile_size) >= THRESHOLD
    assert not (wanted & ~got).any()
    assert (got & ~wanted).sum() < 0.03 * got.sum()


@pytest.mark.parametrize("width", [64, 1024, 8192])
@pytest.mark.parametrize("length", [0.3, 3.0, 300.0, 3000.0])
def test_a_single_pixel_just_above_the_threshold_is_enough(width, length):
    """Leaning ellipses that reach the last tile with one corner pixel, 1e-5 above the threshold, if at all."""
    n, edge = 2000, width - 8
    random = torch.rand(n, 3, generator=torch.Generator().manual_seed(width), dtype=torch.float64)
    angle = 0.35 + 0.8 * random[:, 0]
    lean = torch.stack([angle.cos(), angle.sin()], 1)
    factors = torch.zeros(n, 2, 3)
    factors[:, :, 0] = length * lean
    offset, side = 0.5 + random[:, 1] * min(2 * length, 2000), random[:, 2] - 0.5
    centres = torch.tensor([edge, 7.0]) - offset[:, None] * lean + torch.stack([-0.5 * side - 0.4, side], 1)
    means2d = centres.float()
    wide = factors.double()
    inverse = torch.linalg.inv(wide @ wide.mT + 0.3 * torch.eye(2, dtype=torch.float64))
    d = torch.tensor([edge, 7.0]) - means2d.double()
    reach = torch.exp(((d[:, None] @ inverse) * d[:, None]).sum((1, 2)) / 2)
    bins = bin_to_tiles(footprints(means2d, factors, (THRESHOLD * reach * (1 + 1e-5)).float(), (8, width)))
    reachable = THRESHOLD * reach < 2
    last = bins.ids[bins.entries[bins.offsets[-2] :].long()]
    assert reachable.sum() > 1000
    assert torch.isin(reachable.nonzero()[:, 0], last).all()


def test_threshold_zero_is_every_tile_of_the_own_camera():
    projected = scene(0, cameras=3)
    bins = bin_to_tiles(projected, 8, 0.0)
    check_structure(projected, bins)
    per_camera = bins.grid[0] * bins.grid[1]
    own = torch.arange(3 * per_camera)[None] // per_camera == projected.camera_ids[:, None]
    assert torch.equal(listed(projected, bins), own)


@pytest.mark.parametrize("threshold", [0.0, THRESHOLD])
def test_opacity_zero_or_below_the_threshold_is_in_no_tile(threshold):
    projected = scene(0)
    opacities = projected.opacities.clone()
    opacities[::3] = 0
    opacities[1::3] *= 1 if threshold == 0 else 1e-3
    projected = footprints(projected.means2d, projected.factors, opacities, projected.image_size)
    got = listed(projected, bin_to_tiles(projected, 8, threshold)).any(1)
    assert not got[::3].any()
    assert got[1::3].any() == (threshold == 0)
    assert got[2::3].any()


def test_many_ties_and_negative_depths():
    projected = scene(0, n=300)
    for depths in ((projected.depths * 2).round(), -projected.depths, torch.zeros_like(projected.depths)):
        tied = footprints(
            projected.means2d, projected.factors, projected.opacities, projected.image_size, depths=depths
        )
        check_structure(tied, bin_to_tiles(tied))


# -- slices ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("max_spans", [2**40, 100, 1])
@pytest.mark.parametrize("share", [1.0, 0.5, 0.1, 0.0])
def test_row_slices_cover_all_rows_within_the_budget_and_together_are_the_whole(share, max_spans):
    projected = scene(0, cameras=3)
    coverage, whole = TileCoverage(projected, 8, THRESHOLD, max_spans), bin_to_tiles(projected, 8)
    needs = [
        5 * spans + 7 * entries for spans, entries in zip(coverage.spans_per_row, coverage.entries_per_row, strict=True)
    ]
    budget = max(int(share * sum(needs)), max(needs))
    slices = coverage.row_slices(budget, 5, 7)
    assert [begin for begin, _ in slices] == [0, *(end for _, end in slices[:-1])]
    assert slices[-1][1] == 3 * whole.grid[0]
    assert all(begin < end for begin, end in slices)
    assert len(slices) == 1 if share == 1 else len(slices) > 1
    parts = []
    for begin, end in slices:
        spans = coverage.spans(begin, end)
        part = coverage.lists(spans, begin, end)
        check_structure(projected, part)
        assert 5 * len(spans.ranks) + 7 * len(part.entries) <= budget
        assert (part.first_tile, part.num_tiles) == (begin * whole.grid[1], (end - begin) * whole.grid[1])
        assert (part.tile_size, part.grid) == (8, whole.grid)
        parts.append(part)
    entries = torch.cat([part.ids[part.entries.long()] for part in parts])
    assert torch.equal(entries, whole.ids[whole.entries.long()])
    assert torch.equal(torch.cat([part.offsets.diff() for part in parts]), whole.offsets.diff())


@pytest.mark.parametrize("max_spans", [2**40, 100])
@pytest.mark.parametrize("layers", [1, 3, 10, 1000])
def test_depth_slices_cover_all_ranks_in_about_equal_parts(layers, max_spans):
    projected = scene(0, cameras=2)
    coverage, whole = TileCoverage(projected, 8, THRESHOLD, max_spans), bin_to_tiles(projected, 8)
    slices, rows = coverage.depth_slices(layers), (0, 2 * whole.grid[0])
    assert slices == TileCoverage(projected, 8, THRESHOLD).depth_slices(layers)
    assert [begin for begin, _ in slices] == [0, *(end for _, end in slices[:-1])]
    assert slices[-1][1] == len(whole.ids)
    assert all(begin < end for begin, end in slices)
    entries = [len(coverage.lists(coverage.spans(*rows), *rows, ranks).entries) for ranks in slices]
    assert sum(entries) == len(whole.entries)
    largest = int(torch.bincount(whole.entries).max())  # a slice ends between two Gaussians
    assert max(entries) <= max(len(whole.entries) / len(slices), layers * whole.num_tiles) * 1.5 + 2 * largest
