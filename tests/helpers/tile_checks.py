"""What tests of lists of tiles have in common: brute force, and what every list promises."""

import functools

import torch
from factories import footprints, random_camera, random_gaussians

from kgs import project

THRESHOLD = 1 / 255


INTEGERS = ("offsets", "entries", "ids", "by_gaussian", "gaussian_offsets")


def dots(means2d, size, opacity=0.9, **options):
    """Round footprints of variance 0.3 px^2."""
    means2d = torch.as_tensor(means2d, dtype=torch.float32).reshape(-1, 2)
    return footprints(means2d, torch.zeros(len(means2d), 2, 3), torch.full((len(means2d),), opacity), size, **options)


@functools.cache
def scene(seed, dtype=torch.float32, size=(45, 67), n=150, cameras=1):
    gaussians = random_gaussians(n, seed, dtype, None, max(size))
    parts = [project(gaussians, random_camera(*size, seed + c, dtype)) for c in range(cameras)]
    names = ("means2d", "factors", "opacities", "depths")
    fields = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    camera_ids = torch.cat([torch.full((len(part),), c) for c, part in enumerate(parts)])
    return footprints(size=size, camera_ids=camera_ids, num_cameras=cameras, **fields)


def tiles_of_entries(bins):
    return torch.repeat_interleave(torch.arange(bins.num_tiles), bins.offsets.diff())


def listed(projected, bins):
    """(M, tiles) booleans from the lists; no pair may be listed twice."""
    table = torch.zeros(len(projected), bins.num_tiles, dtype=torch.int64)
    table.index_put_(
        (bins.ids[bins.entries.long()], tiles_of_entries(bins)), torch.ones(len(bins.entries), dtype=torch.int64), True
    )
    assert table.max() <= 1
    return table.bool()


def check_structure(projected, bins):
    """Everything that the docstring of TileLists promises of offsets, order and the inverse permutation."""
    entries, n = bins.entries.long(), len(bins.ids)
    assert bins.entries.dtype == torch.int32
    assert all(getattr(bins, name).dtype == torch.int64 for name in INTEGERS if name != "entries")
    assert bins.offsets[0] == 0
    assert bins.offsets[-1] == len(entries)
    assert (bins.offsets.diff() >= 0).all()
    depths = projected.depths[bins.ids]
    assert (depths.diff() >= 0).all()
    assert (bins.ids.diff()[depths.diff() == 0] > 0).all(), "ties by index"
    tile = tiles_of_entries(bins)
    assert (entries.diff()[tile.diff() == 0] > 0).all(), "front to back, nobody twice"
    rows_of_camera = bins.grid[0]
    camera = (tile + bins.first_tile) // bins.grid[1] // rows_of_camera
    assert torch.equal(projected.camera_ids[bins.ids[entries]], camera)
    # by_gaussian lists the entries of ids[0], then of ids[1], ...; gaussian_offsets where each begins
    assert torch.equal(bins.by_gaussian.sort().values, torch.arange(len(entries)))
    assert torch.equal(entries[bins.by_gaussian], entries.sort().values)
    counts = entries.bincount(minlength=n)
    assert torch.equal(bins.gaussian_offsets, counts.cumsum(0) - counts)
