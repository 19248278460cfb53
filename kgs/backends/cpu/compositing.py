"""Compositing by the kernels: row slices one after another, and bands of each on several threads."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kgs._support.compiled.arrays import arrays
from kgs._support.compiled.threads import parallel_for
from kgs._support.memory import array, empty
from kgs._support.torch_threads import thread_count
from kgs.backends.row_slices import MAX_BYTES, row_slices
from kgs.backends.signatures import Compositor, Images, Inputs
from kgs.geometry.types import ProjectedGaussians, RasterOptions

from . import compositing_kernels as kernels
from .binning import Band, RowSlice, TileCoverage, table_width

_NUMBER = 4  # bytes
Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _Done:
    """A band after the forward pass."""

    band: Band
    starts: Floats  # T at the beginning of each chunk
    strips: NDArray[np.int64]  # which of its entries may reach each strip of the tile, as bits
    reached: NDArray[np.int64]  # how many entries of each tile were composited


class CpuCompositor(Compositor):
    """Compositing of one call: row slices one after another, the bands of each on several threads."""

    def __init__(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool = False,
        chunk_size: int | None = None,
    ) -> None:
        max_bytes = options.max_bytes or MAX_BYTES
        self._blocks = _blocks(features.shape[1])
        channels = sum(width for _, width in self._blocks)
        # a span, and at most one member for it: number, row of the table, sums; an entry, and its share of what is kept
        sums_width = len(self._blocks) * kernels.ROW
        per_span = _NUMBER * (1 + 1 + table_width(channels, median_depth) + sums_width)
        per_entry = _NUMBER * (1 + kernels.P // kernels.K) + 8 * kernels.STRIPS // kernels.K  # int64
        inputs = (projected.means2d, projected.factors, projected.opacities, features)
        self._size = projected.image_size
        self._cameras = projected.num_cameras
        self._median_depth = median_depth
        self._absgrad = options.absgrad
        self._eps2d = np.float32(projected.eps2d)
        self._coverage = TileCoverage(
            arrays(*inputs, projected.depths, projected.camera_ids),
            self._size,
            self._cameras,
            self._eps2d,
            np.float32(options.alpha_threshold),
            channels,
            self._median_depth,
            max_spans=max(2**12, max_bytes // (2 * per_span)),
            threads=thread_count(),
        )
        row_bytes = self._coverage.spans_per_row * per_span + self._coverage.entries_per_row * per_entry
        self._row_slices = row_slices(row_bytes.tolist(), max_bytes)
        self._threshold = np.float32(max(options.alpha_threshold, kernels.TINY))
        self._stop = np.float32(max(options.transmittance_stop, kernels.TINY))
        self._kept: tuple[RowSlice, list[_Done]] | None = None

    def forward(self, inputs: Inputs, keep: bool) -> Images:
        """The images, a row slice after the other; of several none is kept."""
        features = inputs[3]
        transmittance = features.new_empty(self._cameras, 1, *self._size)
        median = features.new_empty(self._cameras, 1 if self._median_depth else 0, *self._size)
        sums = features.new_empty(self._cameras, features.shape[1], *self._size)
        outputs = (
            transmittance[:, 0].numpy(),
            median[:, 0].numpy() if self._median_depth else _nothing(3),
            sums.numpy(),
        )
        keep_slice = keep and len(self._row_slices) == 1
        slices = [self._forward(rows, outputs, keep_slice) for rows in self._row_slices]
        self._kept = slices[0] if keep_slice else None
        return sums, transmittance, median

    def backward(
        self, inputs: Inputs, grad_features: Tensor, grad_transmittance: Tensor, needs: tuple[bool, ...]
    ) -> tuple[tuple[Tensor | None, ...], Tensor | None]:
        """The gradients, a row slice after the other; those that were not kept are composited again."""
        kept, self._kept = self._kept, None
        means2d, factors, opacities, _ = inputs
        needs_moments = any(needs[:3])
        needs_features = needs[3]
        needs_absolute = self._absgrad and needs[0]
        grads, behind = arrays(grad_features, grad_transmittance[:, 0])
        totals = array((len(self._coverage.ids), len(self._blocks) * kernels.ROW))
        totals[:] = 0.0
        no_images = (np.empty_like(behind), _nothing(3), _nothing(4))
        for rows in self._row_slices:
            part, done = self._forward(rows, no_images, True) if kept is None else kept
            kept = None
            self._backward(part, done, grads, behind, totals, needs_absolute)
            del part, done  # before the next is made
        wanted = (*[needs_moments] * 3, needs_features, needs_absolute)
        like = (*inputs, means2d)
        results = [
            empty(tuple(x.shape) if want else (0, *x.shape[1:]), x) for x, want in zip(like, wanted, strict=True)
        ]
        moments = (self._coverage.ranks, totals, *arrays(factors, opacities), self._eps2d)
        parallel_for(thread_count(), len(means2d), kernels.fill_gradients, *moments, *arrays(*results))
        gradients = tuple(x if need else None for x, need in zip(results[:4], needs, strict=True))
        return gradients, results[4] if needs_absolute else None

    def _forward(self, rows: tuple[int, int], outputs: tuple[Floats, ...], keep: bool) -> tuple[RowSlice, list[_Done]]:
        """Fill transmittance, median depth and sums; without sums only compute what `backward` needs again."""
        part = self._coverage.row_slice(*rows)
        transmittance, median, sums = outputs
        count = len(part.bounds) - 1
        done: list[_Done] = [None] * count  # type: ignore[list-item]

        def work(begin: int, end: int) -> None:
            for b in range(begin, end):
                band = self._coverage.band(part, b)
                tiles = len(band.offsets) - 1
                chunks = len(band.entries) // kernels.K + tiles if keep else 0
                starts = array((chunks, kernels.P))
                strips = np.empty((chunks, kernels.STRIPS), np.int64)
                reached = np.empty(tiles, np.int64)
                lists = (band.first_tile, self._coverage.grid, band.offsets, band.entries, band.table)
                for first, width in self._blocks if len(sums) else self._blocks[:1]:
                    out = (starts, strips, reached, transmittance, median, sums)
                    kernels.composite_forward(*lists, self._threshold, self._stop, first, (0,) * width, *out)
                if keep:
                    done[b] = _Done(band, starts, strips, reached)

        parallel_for(thread_count(), count, work, pieces=count)
        return part, done

    def _backward(
        self,
        part: RowSlice,
        done: list[_Done],
        grads: Floats,
        grad_transmittance: Floats,
        totals: Floats,
        needs_absolute: bool,
    ) -> None:
        """Add to `totals` what each Gaussian gets, a row for each block of features."""
        sums = array((len(self._blocks), len(part.members), kernels.ROW))

        def work(begin: int, end: int) -> None:
            for own in done[begin:end]:
                band = own.band
                lists = (band.first_tile, self._coverage.grid, band.offsets, band.entries, band.table)
                of_band = (own.starts, own.strips, own.reached, grads, grad_transmittance, needs_absolute)
                for (first, width), rows in zip(self._blocks, sums, strict=True):
                    rows[band.members] = 0.0
                    block = (self._threshold, self._stop, first, (0,) * width)
                    kernels.composite_backward(*lists, *block, *of_band, rows[band.members])

        threads = thread_count()
        parallel_for(threads, len(done), work, pieces=len(done))
        parallel_for(threads, len(totals), kernels.add_members, part.offsets, part.members, sums, totals)


def _blocks(features: int) -> list[tuple[int, int]]:
    """Where blocks of features begin, and how many each has: what kernels are compiled for, the last padded."""
    maximum = kernels.WIDTHS[-1]
    begins = range(0, max(features, 1), maximum)
    return [(begin, next(w for w in kernels.WIDTHS if w >= min(features - begin, maximum))) for begin in begins]


def _nothing(dimensions: int) -> Floats:
    return np.empty((0,) * dimensions, np.float32)
