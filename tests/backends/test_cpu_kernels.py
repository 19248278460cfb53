"""What only the numba kernels have: lists in bands, vector code, one cache on the disk."""

import dataclasses
import itertools
import re

import numpy as np
import pytest
import torch
from compositing_checks import TH
from kernel_checks import assembly, avx_assembly
from tile_checks import scene

from kgs.backends.torch.binning import bin_to_tiles

nb = pytest.importorskip("numba")

from kgs._support.compiled.arrays import arrays  # noqa: E402  # needs numba
from kgs._support.compiled.lanes import WIDTH, load, store  # noqa: E402  # needs numba
from kgs.backends.cpu import binning_kernels, loss_kernels, projection_kernels  # noqa: E402  # needs numba
from kgs.backends.cpu import compositing_kernels as kernels  # noqa: E402  # needs numba
from kgs.backends.cpu.binning import TileCoverage  # noqa: E402  # needs numba
from kgs.init_points import matching_kernels, sweep_kernels  # noqa: E402  # needs numba


@pytest.fixture(autouse=True)
def _many_bands(monkeypatch):
    """Small pictures in as many bands as large ones are."""
    monkeypatch.setattr("kgs.backends.cpu.binning.MIN_ENTRIES", 1)


def coverage_of(projected, threshold=TH, max_spans=2**40):
    inputs = (projected.means2d, projected.factors, projected.opacities, projected.colors)
    fields = arrays(*inputs, projected.depths, projected.camera_ids)
    eps2d, threshold = np.float32(projected.eps2d), np.float32(threshold)
    return TileCoverage(fields, projected.image_size, projected.num_cameras, eps2d, threshold, 3, False, max_spans, 2)


@pytest.mark.parametrize("rows", [None, (2, 5), (4, 5)])
@pytest.mark.parametrize(("cameras", "threshold"), [(1, TH), (3, TH), (2, 0.0)])
def test_lists_are_those_of_torch(cameras, threshold, rows):
    for seed in range(4):
        projected = scene(seed, cameras=cameras)
        off = torch.rand(len(projected), generator=torch.Generator().manual_seed(seed)) < 0.2
        depths = projected.depths.round(decimals=1) - 4  # ties, and both signs
        depths[::7] = -0.0
        opacities = projected.opacities.masked_fill(off, 0.0)
        projected = dataclasses.replace(projected, depths=depths, opacities=opacities)
        bins, coverage = bin_to_tiles(projected, 8, threshold), coverage_of(projected, threshold)
        begin, end = rows or (0, coverage.total_rows)
        expected = torch.tensor_split(bins.ids[bins.entries.long()], bins.offsets[1:-1])
        part, tile = coverage.row_slice(begin, end), begin * bins.grid[1]
        for b in range(len(part.bounds) - 1):
            band = coverage.band(part, b)
            assert band.first_tile == tile
            ids = coverage.ids[part.members[band.members][band.entries]]
            assert not off[torch.from_numpy(ids)].any()
            for got in np.split(ids, band.offsets[1:-1]):
                assert got.tolist() == expected[tile].tolist()
                tile += 1
        assert tile == end * bins.grid[1]


def layers_of_a_chunk(seed, n):
    """Rows as of a table about the centre of a tile: of all sizes and opacities, round and thin, near and far."""
    generator = np.random.default_rng(seed)
    rows = np.zeros((kernels.K, kernels.ROW), np.float32)
    rows[:, 0] = generator.uniform(-9.0, 2.0, kernels.K)
    rows[:, 1:3] = generator.normal(size=(kernels.K, 2)) * 10.0 ** generator.uniform(-1.0, 6.0, (kernels.K, 1))
    along, across = 10.0 ** generator.uniform(-3.0, 1.0, (2, kernels.K))
    slope, wide = generator.uniform(-1.0, 1.0, kernels.K), generator.random(kernels.K) < 0.5
    rows[wide, 3:7] = np.stack([slope * across, across, along, 0.0 * along], 1)[wide]
    rows[~wide, 3:7] = np.stack([across, slope * across, 0.0 * along, along], 1)[~wide]
    on_the_axis = generator.random(kernels.K) < 0.5  # far away, and thin, and through the tile
    rows[on_the_axis & wide, 2] = (-slope * rows[:, 1])[on_the_axis & wide]
    rows[on_the_axis & ~wide, 1] = (-slope * rows[:, 2])[on_the_axis & ~wide]
    rows[n:] = np.nan
    return rows


@nb.njit
def strips_and_alphas(layers, n, threshold, pixels, strips, alphas):
    kernels.fill_pixels(pixels)
    kernels.find_strips(layers, n, np.float32(np.log2(threshold)), strips)
    for k in range(n):
        for p in range(0, kernels.P, WIDTH):
            alpha = kernels.alpha_of(layers, k, load(pixels, p), load(pixels, kernels.P + p), threshold)
            store(alphas, k * kernels.P + p, alpha)


def find_strips(rows, n, threshold):
    """For each of n layers and the strips of a tile: whether it is found, and its largest alpha."""
    strips = np.empty(kernels.STRIPS, np.int64)
    alphas = np.empty(kernels.K * kernels.P, np.float32)
    pixels = np.empty(2 * kernels.P, np.float32)
    strips_and_alphas(rows.reshape(-1), n, np.float32(threshold), pixels, strips, alphas)
    assert not (strips >> n).any()
    found = (strips[None] >> np.arange(n)[:, None]) & 1 == 1
    return found, alphas.reshape(kernels.K, kernels.STRIPS, -1)[:n].max(2)


@pytest.mark.parametrize("n", [1, 16, 17, 32])
@pytest.mark.parametrize("threshold", [TH, 0.5, kernels.TINY])
def test_strips_where_an_alpha_counts_are_found(threshold, n):
    missed = 0
    for seed in range(40):
        found, alphas = find_strips(layers_of_a_chunk(seed, n), n, threshold)
        assert not alphas[~found].any()
        missed += (~found).sum()
    assert missed > 20 * n  # of 160 n


def test_strips_are_found_that_are_reached_by_a_rounding():
    for seed in range(100):
        rows = layers_of_a_chunk(seed, kernels.K)
        rows[:, 0] = 0.0
        _, alphas = find_strips(rows, kernels.K, kernels.TINY)
        alpha = np.maximum(alphas[:, seed % kernels.STRIPS], kernels.TINY)
        rows[:, 0] = np.log2(TH) - np.log2(alpha.astype(np.float64))  # the largest alpha of this strip is the threshold
        found, alphas = find_strips(rows, kernels.K, TH)
        assert not alphas[~found].any()


def test_strips_are_found_whatever_is_not_finite():
    for column, bad in itertools.product(range(7), (np.nan, np.inf, -np.inf, 3e38, -3e38)):
        rows = layers_of_a_chunk(0, kernels.K)
        rows[:, column] = bad
        found, alphas = find_strips(rows, kernels.K, TH)
        assert not alphas[~found].any()


FLOATS = r"(?:fn?m(?:add|sub)\d*|mul|add|sub)"
PACKED = rf"\tv?{FLOATS}ps\b.*[yz]mm|\tf(?:mla|mls|mul|add|sub)(?:\.4s|\tv\d+\.4s)"  # x86, arm
SCALAR = rf"\tv?{FLOATS}ss\b|\tf(?:n?m(?:add|sub)|mul|add|sub)\ts\d"


@pytest.mark.slow
@pytest.mark.parametrize("kernel", [kernels.composite_forward, kernels.composite_backward], ids=["forward", "backward"])
def test_pixels_are_the_lanes(kernel):
    """LLVM leaves a loop scalar without a word: see the rules in `kgs.backends.cpu`."""
    f, i8 = nb.float32, nb.int64
    types = {"grid": nb.types.UniTuple(i8, 2), "offsets": i8[::1], "entries": nb.int32[::1], "table": f[:, ::1]}
    types |= {"threshold": f, "stop": f, "channels": nb.types.UniTuple(i8, 3)}
    types |= dict.fromkeys(("transmittance", "depths", "grad_transmittance"), f[:, :, ::1])
    types |= {"starts": f[:, ::1], "strips": i8[:, ::1], "reached": i8[::1]}
    types |= {"grads": f[:, :, :, ::1], "needs_absolute": nb.boolean}
    types |= {"sums": f[:, :, :, ::1] if kernel is kernels.composite_forward else f[:, ::1]}
    names = kernel.py_func.__code__.co_varnames[: kernel.py_func.__code__.co_argcount]
    text = assembly(kernel, *(types.get(name, i8) for name in names))
    packed, scalar = (len(re.findall(pattern, text)) for pattern in (PACKED, SCALAR))
    assert packed > max(24, 1.5 * scalar)  # forward has 33 with AVX-512 and twice as many with AVX2


ROWS, IMAGE, MAPS = nb.float32[:, ::1], nb.float32[:, :, ::1], nb.float32[:, :, :, ::1]
NUMBERS, SUMS = nb.float32[::1], nb.float64[:, ::1]
LENGTHS = [nb.types.UniTuple(nb.float32, count) for count in range(7)]
FOUND = (nb.float32, NUMBERS, NUMBERS, nb.int64[::1], ROWS, ROWS, nb.int64[:, ::1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kernel", "arguments", "pattern", "operations"),  # of the loops over columns, planes or descriptors, in the source
    [
        (loss_kernels.ssim_maps, (LENGTHS[6], *[IMAGE] * 4, MAPS, SUMS), "add|sub|mul", 90),
        (loss_kernels.ssim_gradient, (LENGTHS[6], IMAGE, IMAGE, MAPS, IMAGE), "add|sub|mul", 26),
        (loss_kernels.total_gradient, (*[IMAGE] * 3, nb.float32, nb.float32, IMAGE), "add|sub|mul", 6),
        (
            sweep_kernels.compare_tiles,
            (ROWS, SUMS, ROWS, LENGTHS[3], IMAGE, nb.float64[:, :, :, ::1], IMAGE),
            "add|sub",
            32,
        ),
        (sweep_kernels.add_paths, (IMAGE, ROWS, nb.int64, nb.int64, LENGTHS[4], IMAGE), "add|sub|min|cmp", 9),
        (matching_kernels.find_nearest, (*[ROWS] * 4, *FOUND), "sub", 1),
        (matching_kernels.find_nearest, (*[ROWS] * 4, *FOUND), "add|mul|fm", 1),
        (matching_kernels.find_nearest, (*[ROWS] * 4, *FOUND), "and", 1),
    ],
)
def test_inner_loops_are_vector_code(kernel, arguments, pattern, operations):
    """All that they compute stands in the assembly for whole AVX registers; single numbers are what is left over."""
    assembly = avx_assembly(kernel, nb.int64, nb.int64, *arguments)
    assert len(re.findall(rf"\bv\w*(?:{pattern})\w*p[sd]\b.*[yz]mm", assembly)) >= operations


def stamp(kernel):
    return kernel._cache._cache_file._source_stamp[-1]


def test_kernels_are_compiled_anew_when_any_file_of_their_folder_changes():
    shared = stamp(projection_kernels.footprints)
    assert len(shared) == 64
    assert stamp(binning_kernels.sort_by_depth) == shared
    assert stamp(matching_kernels.find_nearest) != shared
