"""Lists of row slices and depth slices."""

import pytest
import torch
from tile_checks import THRESHOLD, check_structure, scene

from kgs.backends.torch.binning import TileCoverage, bin_to_tiles


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
