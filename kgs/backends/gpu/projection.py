"""Projection by the kernels: pinhole cameras; others go to torch."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.backends.torch.projection import project as project_in_torch
from kgs.camera import MARGIN, Cameras, whole_frame
from kgs.projection import visibility_cutoff
from kgs.types import Gaussians, ProjectedGaussians, RasterOptions

from .camera_kernels import COVERED, WIDTH, describe_cameras
from .launch import blocks, launch, wide_sum
from .projection_kernels import check_gaussians, find_visible, footprint_gradients, list_visible

_BLOCK = 128  # Gaussians of a program


def project(
    gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
) -> ProjectedGaussians:
    """See `ProjectionStage`; reads how many are visible. What the kernels cannot do is done in torch."""
    near = options.near_plane < 1e-8  # Kornia does not divide by less
    if not isinstance(cameras, PinholeCamera) or gaussians.quats.ndim == 3 or near:
        return project_in_torch(gaussians, cameras, size, options, colors)
    visible = _find_visible(gaussians, cameras, size, options)
    if visible is None:
        return project_in_torch(gaussians, cameras, size, options, colors)
    harmonics = colors and gaussians.colors.ndim == 3
    inputs = (*vars(gaussians).values(), cameras.extrinsics, cameras.intrinsics)
    fields = _Projection.apply(*inputs, visible, options.near_plane, options.eps2d, harmonics)
    means2d, factors, depths, alphas, rgb, radii, camera_ids, ids = fields
    if colors and not harmonics:
        # camera by camera: the gradients of equal rows would be added up in any order
        rgb = torch.cat([gaussians.colors.index_select(0, part) for part in ids.split(visible.counts)])
    return ProjectedGaussians(
        camera_ids,
        ids,
        means2d,
        factors,
        depths,
        radii,
        alphas,
        rgb,
        image_size=size,
        num_cameras=len(cameras.extrinsics),
        num_gaussians=len(gaussians),
        num_nonfinite=visible.num_nonfinite,
        eps2d=options.eps2d,
    )


@dataclass(frozen=True)
class _Visible:
    """Which pairs (camera, Gaussian) are visible."""

    cameras: Tensor  # (C, WIDTH), a row of numbers for each camera, see `.camera_kernels`
    running_counts: Tensor  # (C N,), how many pairs are visible up to and including each
    counts: list[int]  # how many Gaussians each camera sees
    num_nonfinite: Tensor  # 0-d


def _find_visible(
    gaussians: Gaussians, cameras: PinholeCamera, size: tuple[int, int], options: RasterOptions
) -> _Visible | None:
    """What the cameras see; None where the kernels do not cover one of the cameras, or there are no Gaussians."""
    n = len(gaussians)
    if n == 0:
        return None
    values, opacities, colors = _values(gaussians)
    rows = _describe(cameras, size, options)
    finite = values[0].new_empty(n, dtype=torch.int8)
    largest = values[0].new_empty(blocks(n, _BLOCK))
    checked = (*values, opacities, colors, n, len(opacities), colors.shape[1], finite, largest)
    launch(check_gaussians, (blocks(n, _BLOCK),), *checked, BLOCK=_BLOCK)
    cutoff = visibility_cutoff(largest, options.alpha_threshold)
    flags = finite.new_empty(len(rows), n, dtype=torch.int32)
    frustum = (cutoff, options.near_plane, options.eps2d, *size)
    launch(find_visible, (blocks(n, _BLOCK), len(rows)), *values, finite, rows, *frustum, n, flags, BLOCK=_BLOCK)
    running_counts = torch.cumsum(flags.view(-1), 0)
    *ends, covered = torch.cat([running_counts[n - 1 :: n], rows[:, COVERED].amin().long()[None]]).tolist()
    if not covered:
        return None
    counts = [end - begin for begin, end in pairwise([0, *ends])]
    return _Visible(rows, running_counts, counts, n - finite.sum())


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
        means, quats, scales, opacities, colors, _, _, visible, near, eps2d, harmonics = arguments
        ctx.save_for_backward(*arguments[:5])  # not the cameras: they may have been made in inference mode
        ctx.visible = visible
        ctx.harmonics = harmonics
        n = len(means)
        count = sum(visible.counts)
        bands = colors.shape[1] if harmonics else 0
        widths = ((2,), (2, 3), (), (), (3 if harmonics else 0,), ())
        fields = [means.new_empty(count, *width) for width in widths]
        camera_ids, ids = (visible.running_counts.new_empty(count) for _ in range(2))
        values = [x.contiguous() for x in (means, quats, scales, opacities, colors)]
        options = (visible.cameras, visible.running_counts, near, eps2d, n, opacities.numel() // n)
        grid = (blocks(n, _BLOCK), len(visible.cameras))
        launch(list_visible, grid, *values, *options, *fields, camera_ids, ids, BANDS=bands, BLOCK=_BLOCK)
        by_mean, by_turn, by_scale, by_opacity, by_color, by_pose, by_lens = ctx.needs_input_grad[:7]
        by_position = by_mean or by_pose
        by_shape = by_position or by_lens or by_turn or by_scale
        colored = harmonics and (by_color or (by_position and bands > 1))
        differentiable = (by_position or by_lens, by_shape, by_position, by_opacity, colored, False)
        constant = [x for x, varies in zip(fields, differentiable, strict=True) if not varies]
        ctx.mark_non_differentiable(*constant, camera_ids, ids)
        return *fields, camera_ids, ids

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():
            raise RuntimeError("project: expected backward without create_graph, footprints have no second derivative")
        inputs = ctx.saved_tensors
        means, quats, scales, opacities, colors = inputs
        cameras = ctx.visible.cameras
        n = len(means)
        views = opacities.numel() // n
        needs = list(ctx.needs_input_grad[:7])
        needs[4] = needs[4] and ctx.harmonics
        input_grads = [x.new_empty(x.shape) for x in inputs[:4]]
        input_grads.append(colors.new_empty(colors.shape if needs[4] else (0,)))  # the largest by far
        values = [x.contiguous() for x in (means, quats, scales, colors)]
        incoming = [x.contiguous() for x in gradients[:5]]
        poses, intrinsics = means.new_zeros(2, len(cameras), 4, 4)
        count = blocks(n, _BLOCK)
        totals = means.new_empty(count, 21)
        for c in range(len(cameras)):
            launch(
                footprint_gradients,
                (count,),
                *(c, *values, cameras, ctx.visible.running_counts, n, views, *incoming, *input_grads, totals),
                BANDS=colors.shape[1] if ctx.harmonics else 0,
                WITH_COLORS=needs[4],
                WITH_CAMERA=any(needs[5:]),
                ADD=c > 0,
                BLOCK=_BLOCK,
            )
            if any(needs[5:]):
                total = wide_sum(totals, 0).float()
                poses[c, :3] = total[:12].view(3, 4)
                intrinsics[c, :3, :3] = total[12:].view(3, 3)
        input_grads += [poses, intrinsics]
        return *(x if need else None for x, need in zip(input_grads, needs, strict=True)), None, None, None, None
