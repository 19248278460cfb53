"""Many tiles, and lists of row slices and depth slices."""

import pytest
import torch
from tile_checks import THRESHOLD, check_structure, dots, scene, tiles_of_entries

from kgs.backends.torch.binning import TileCoverage, bin_to_tiles


@pytest.mark.parametrize("cameras", [1, 16])
def test_tile_numbers_beyond_16_bits(cameras):
    """16 cameras of 4096 px: a dot at the middle of a random tile is in that tile alone."""
    height, width = 64, 4096
    grid, generator = (16, 1024), torch.Generator().manual_seed(0)
    m = 3000
    camera, row, column = (torch.randint(0, high, (m,), generator=generator) for high in (cameras, *grid))
    camera[:2], row[:2], column[:2] = torch.tensor([0, cameras - 1]), torch.tensor([0, 15]), torch.tensor([0, 1023])
    camera, order = camera.sort(stable=True)
    row, column = row[order], column[order]
    means2d = torch.stack([column * 4 + 1.5, row * 4 + 1.5], 1)
    depths = torch.rand(m, generator=generator)
    projected = dots(means2d, (height, width), 0.2, camera_ids=camera, num_cameras=cameras, depths=depths)
    bins = bin_to_tiles(projected, 4)
    assert bins.num_tiles == cameras * 16 * 1024
    check_structure(projected, bins)
    tile = torch.empty(m, dtype=torch.int64)
    tile[bins.ids[bins.entries.long()]] = tiles_of_entries(bins)
    assert len(bins.entries) == m
    assert torch.equal(tile, (camera * grid[0] + row) * grid[1] + column)


@pytest.mark.parametrize("rows", [2**15 // 64 - 1, 2**15 // 64, 2**15 // 64 + 1])
def test_tile_counts_around_the_border_of_16_bits(rows):
    projected = dots([[2.0, 2.0], [2.0 + 63 * 4, 2.0 + 4 * (rows - 1)]], (4 * rows, 256), 0.1)
    bins = bin_to_tiles(projected, 4)
    assert bins.num_tiles == 64 * rows
    assert tiles_of_entries(bins).tolist() == [0, 64 * rows - 1]


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


@pytest.mark.parametrize("rows", [(0, 12), (3, 7)])
@pytest.mark.parametrize("ranks", [None, (0, 40), (25, 31)])
@pytest.mark.parametrize("share", [None, 0.0, 0.4, 1.0])
def test_lists_of_some_depths_and_some_tiles_are_parts_of_the_whole_ones(rows, ranks, share):
    projected = scene(0, cameras=2)
    coverage = TileCoverage(projected, 8, THRESHOLD)
    spans = coverage.spans(*rows)
    whole, low, high = coverage.lists(spans, *rows), *(ranks or (0, len(coverage.ids)))
    live = None if share is None else torch.rand(whole.num_tiles) < share
    part = coverage.lists(spans, *rows, ranks, live)
    check_structure(projected, part)
    assert torch.equal(part.ids, whole.ids[low:high])
    for t in range(whole.num_tiles):
        expected = whole.entries[whole.offsets[t] : whole.offsets[t + 1]]
        expected = expected[(expected >= low) & (expected < high)] - low
        if live is not None and not live[t]:
            expected = expected[:0]
        assert torch.equal(part.entries[part.offsets[t] : part.offsets[t + 1]], expected)


@pytest.mark.parametrize("max_spans", [2**40, 200, 1])
def test_spans_and_entries_per_row_are_what_the_rows_hold(max_spans):
    projected = scene(0, cameras=2)
    coverage, whole = TileCoverage(projected, 8, THRESHOLD, max_spans), bin_to_tiles(projected, 8)
    assert coverage.entries_per_row == whole.offsets.diff().reshape(-1, whole.grid[1]).sum(1).tolist()
    assert coverage.num_entries == len(whole.entries)
    assert coverage.spans_per_row == [len(coverage.spans(row, row + 1).ranks) for row in range(12)]
