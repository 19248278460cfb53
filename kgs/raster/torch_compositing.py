"""Compositing of one call in torch, by the passes of `torch_passes`."""

from typing import Any

import torch
from torch import Tensor

from kgs.covariance import moment_gradients
from kgs.full_precision import full_precision
from kgs.types import ProjectedGaussians, RasterOptions

from . import tasks, torch_passes
from .tasks import Rules
from .tiles import Reach, to_images, to_tiles


class TorchCompositing:
    """A compositor for every device and dtype, see `kgs.backends.base.Compositor`."""

    def __init__(
        self,
        projected: ProjectedGaussians,
        features: Tensor,
        options: RasterOptions,
        median_depth: bool,
        chunk_size: int | None,
    ) -> None:
        tile_size = options.tile_size or 8
        buffers, number = tasks.buffer_bytes(options.max_bytes, features), features.element_size()
        budget = options.max_bytes - buffers * (4 if features.device.type == "cpu" else 1)  # some threads, one GPU
        # working memory of a Gaussian in a row of tiles; and in a tile: lists, sorting, gradients, sum, saved light
        per_span, per_entry = 32 + 16 * number, 80 + (8 + 2 * features.shape[1] + tile_size**2 // 8) * number
        reach = Reach(projected, tile_size, options.alpha_threshold, max(2**12, budget // (2 * per_span)))
        slices = reach.row_slices(budget, per_span, per_entry)
        size = chunk_size or tasks.choose_chunk_size(reach)
        threads = max(4, options.max_bytes // 4 // max(1, buffers))
        rules = Rules(options.alpha_threshold, options.transmittance_stop, median_depth, size, buffers, threads)
        spare = budget - per_entry * reach.num_entries - per_span * reach.num_spans // 4
        self._passes = torch_passes._Passes(projected, reach, slices, rules, spare if len(slices) == 1 else 0)

    def forward(self, inputs: tuple[Tensor, ...], keep: bool) -> tuple[tuple[Tensor, Tensor, Tensor], Any]:
        """See `Compositor`: one row slice is kept, several are made again."""
        passes, keep_slice = self._passes, keep and len(self._passes.row_slices) == 1
        with full_precision(inputs[0].device):
            parts, done = zip(*(passes.forward(inputs, rows, keep_slice) for rows in passes.row_slices), strict=True)
        grid, size = passes.reach.grid, passes.projected.image_size
        sums, transmittance, median = (to_images(torch.cat(x), grid, size) for x in zip(*parts, strict=True))
        return (sums, transmittance, median), done[0] if keep_slice else None

    def backward(
        self,
        inputs: tuple[Tensor, ...],
        kept: Any,
        grad_features: Tensor,
        grad_transmittance: Tensor,
        needs: tuple[bool, ...],
    ) -> tuple[Tensor | None, ...]:
        """See `Compositor`."""
        passes, reach = self._passes, self._passes.reach
        _, factors, opacities, _ = inputs
        grads, behind = (to_tiles(x, reach.grid, reach.tile_size) for x in (grad_features, grad_transmittance))
        moments, width = any(needs[:3]), grads.shape[1] if needs[3] else 0
        total = factors.new_zeros(reach.ids.shape[0], 6 * moments + width)
        with full_precision(factors.device):
            for begin, end in passes.row_slices:
                done, kept = kept, None
                if done is None:
                    done = passes.forward(inputs, (begin, end), keep=True)[1]
                tiles = slice(begin * reach.grid[1], end * reach.grid[1])
                passes.backward(done, grads[tiles], behind[tiles], total, moments, width > 0)
                del done
        found: tuple[Tensor | None, ...] = (None, None, None, total[:, total.shape[1] - width :])
        if moments:
            used, opaque = (x.index_select(0, reach.ids) for x in (factors, opacities))
            found = (*moment_gradients(total[:, :6], used, opaque, passes.projected.eps2d), found[3])

        def of_all(value: Tensor) -> Tensor:
            return value.new_zeros(factors.shape[0], *value.shape[1:]).index_copy_(0, reach.ids, value)

        return tuple(of_all(x) if needed and x is not None else None for x, needed in zip(found, needs, strict=True))
