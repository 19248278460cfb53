"""Projection by the kernels: pinhole cameras; others go to torch."""

from itertools import pairwise
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import MARGIN, Cameras, whole_frame
from kgs.projection import project_torch, seen_within
from kgs.types import Gaussians, ProjectedGaussians, RasterOptions

from .camera_kernels import PLAIN, WIDTH, describe_cameras
from .launch import blocks, launch, wide_sum
from .projection_kernels import check_gaussians, find_seen, footprint_gradients, list_seen

_BLOCK = 128  # Gaussians of a program


def project(
    gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
) -> ProjectedGaussians:
    """`kgs.projection.project_torch` on the kernels, where they can do the call; reads how many are seen."""
    small = options.near_plane < 1e-8  # Kornia does not divide by less
    if not isinstance(cameras, PinholeCamera) or gaussians.quats.ndim == 3 or small:
        return project_torch(gaussians, cameras, size, options, colors)
    seen = _find(gaussians, cameras, size, options)
    if seen is None:
        return project_torch(gaussians, cameras, size, options, colors)
    rows, places, broken, counts = seen
    harmonics = colors and gaussians.colors.ndim == 3
    rules = (options.near_plane, options.eps2d)
    inputs = (*vars(gaussians).values(), cameras.extrinsics, cameras.intrinsics)
    fields = _Projection.apply(*inputs, rows, places, sum(counts), rules, harmonics)
    means2d, factors, depths, alphas, rgb, radii, camera_ids, ids = fields
    if colors and not harmonics:
        # camera by camera: the gradients of equal rows would be added up in any order
        rgb = torch.cat([gaussians.colors.index_select(0, part) for part in ids.split(counts)])
    tensors = (camera_ids, ids, means2d, factors, depths, radii, alphas, rgb)
    return ProjectedGaussians(*tensors, size, len(cameras.extrinsics), len(gaussians), broken, options.eps2d)


def _find(
    gaussians: Gaussians, cameras: PinholeCamera, size: tuple[int, int], options: RasterOptions
) -> tuple[Tensor, Tensor, Tensor, list[int]] | None:
    """Rows that describe the cameras, places of what they see, how many Gaussians are not finite, how many each sees.

    None where the kernels cannot draw one of the cameras, or there are no Gaussians.
    """
    n = len(gaussians)
    if n == 0:
        return None
    values, opacities, colors = _values(gaussians)
    rows = _describe(cameras, size, options)
    finite, largest = values[0].new_empty(n, dtype=torch.int8), values[0].new_empty(blocks(n, _BLOCK))
    checked = (*values, opacities, colors, n, len(opacities), colors.shape[1], finite, largest)
    launch(check_gaussians, (blocks(n, _BLOCK),), *checked, BLOCK=_BLOCK)
    cutoff = seen_within(largest, options.alpha_threshold)
    seen = finite.new_empty(len(rows), n, dtype=torch.int32)
    rules = (cutoff, options.near_plane, options.eps2d, *size, n, seen)
    launch(find_seen, (blocks(n, _BLOCK), len(rows)), *values, finite, rows, *rules, BLOCK=_BLOCK)
    places = torch.cumsum(seen.view(-1), 0)
    *ends, plain = torch.cat([places[n - 1 :: n], rows[:, PLAIN].amin().long()[None]]).tolist()
    counts = [end - begin for begin, end in pairwise([0, *ends])]
    return (rows, places, n - finite.sum(), counts) if plain else None


def _describe(cameras: PinholeCamera, size: tuple[int, int], options: RasterOptions) -> Tensor:
    """A row of numbers for each camera, see `.camera_kernels`."""
    matrices = [x.detach().contiguous() for x in (cameras.intrinsics, cameras.extrinsics)]
    left, top, right, bottom = options.frame or whole_frame(size)
    margins = (MARGIN * (right - left), MARGIN * (bottom - top))
    rows = matrices[0].new_empty(len(matrices[0]), WIDTH)
    launch(describe_cameras, (len(rows),), *matrices, left, top, right, bottom, *margins, rows, warps=1)
    return rows


def _values(gaussians: Gaussians) -> tuple[list[Tensor], Tensor, Tensor]:
    """Means, quaternions and scales; opacities `(1, N)` or `(C, N)`; colours `(N, F)`: contiguous, without gradient."""
    *values, opacities, colors = (x.detach().contiguous() for x in vars(gaussians).values())
    return (
        values,
        opacities.view(-1, len(gaussians)),
        colors.view(len(colors), -1) if colors.numel() else colors.flatten(1),
    )


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        means, quats, scales, opacities, colors, _, _, rows, places, count, (near, eps2d), harmonics = arguments
        ctx.save_for_backward(*arguments[:5])  # not the cameras: they may have been made in inference mode
        ctx.rest = rows, places, harmonics
        n, views = len(means), opacities.numel() // len(means)
        bands = colors.shape[1] if harmonics else 0
        widths = ((2,), (2, 3), (), (), (3 if harmonics else 0,), ())
        found = [means.new_empty(count, *width) for width in widths]
        camera_ids, ids = (places.new_empty(count) for _ in range(2))
        given = [x.contiguous() for x in (means, quats, scales, opacities, colors)]
        rules = (rows, places, near, eps2d, n, views)
        grid = (blocks(n, _BLOCK), len(rows))
        launch(list_seen, grid, *given, *rules, *found, camera_ids, ids, BANDS=bands, BLOCK=_BLOCK)
        by_mean, by_turn, by_scale, by_opacity, by_color, by_pose, by_lens = ctx.needs_input_grad[:7]
        by_place = by_mean or by_pose
        by_shape = by_place or by_lens or by_turn or by_scale
        colored = harmonics and (by_color or (by_place and bands > 1))
        wants = (by_place or by_lens, by_shape, by_place, by_opacity, colored, False)
        constant = [x for x, wanted in zip(found, wants, strict=True) if not wanted]
        ctx.mark_non_differentiable(*constant, camera_ids, ids)
        return *found, camera_ids, ids

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("project: expected backward without create_graph, footprints have no second derivative")
        inputs, (rows, places, harmonics) = ctx.saved_tensors, ctx.rest
        means, quats, scales, opacities, colors = inputs
        n, views, needs = len(means), opacities.numel() // len(means), list(ctx.needs_input_grad[:7])
        needs[4] = needs[4] and harmonics
        found = [x.new_empty(x.shape) for x in inputs[:4]]
        found.append(colors.new_empty(colors.shape if needs[4] else (0,)))  # the largest by far
        given = [x.contiguous() for x in (means, quats, scales, colors)]
        incoming = [x.contiguous() for x in gradients[:5]]
        matrices, count = means.new_zeros(2, len(rows), 4, 4), blocks(n, _BLOCK)
        totals = means.new_empty(count, 21)
        for c in range(len(rows)):
            launch(
                footprint_gradients,
                (count,),
                *(c, *given, rows, places, n, views, *incoming, *found, totals),
                BANDS=colors.shape[1] if harmonics else 0,
                WITH_COLORS=needs[4],
                WITH_CAMERA=any(needs[5:]),
                ADD=c > 0,
                BLOCK=_BLOCK,
            )
            if any(needs[5:]):
                total = wide_sum(totals, 0).float()
                matrices[0, c, :3], matrices[1, c, :3, :3] = total[:12].view(3, 4), total[12:].view(3, 3)
        found += matrices
        return *(x if needed else None for x, needed in zip(found, needs, strict=True)), None, None, None, None, None
