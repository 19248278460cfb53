"""Projection by the kernels: pinhole cameras; others go to torch."""

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative
from kgs.backends.torch.projection import project as project_in_torch
from kgs.geometry.cameras import Cameras
from kgs.geometry.lenses import MARGIN, whole_frame
from kgs.geometry.types import Gaussians, ProjectedGaussians, RasterOptions

from . import entry_counts
from .binning_kernels import count_all_entries, sum_counts
from .camera_kernels import WIDTH, describe_cameras
from .compositing import LANES
from .compositing_kernels import SIZE
from .launch import blocks, launch, wide_sum
from .projection_kernels import check_gaussians, find_visible, footprint_gradients, list_visible, number_rows

_BLOCK = 128  # Gaussians of a program
_SUMS = 1024  # numbers that a single program takes at once


def project(
    gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
) -> ProjectedGaussians:
    """Gaussians as pinhole cameras see them, by the kernels, and through other lenses in torch.

    Reads how many are visible.
    """
    near = options.near_plane < 1e-8  # Kornia does not divide by less
    if not isinstance(cameras, PinholeCamera) or gaussians.quats.ndim == 3 or near:
        return project_in_torch(gaussians, cameras, size, options, colors)
    harmonics = colors and gaussians.colors.ndim == 3
    listed = _list(gaussians, cameras, size, options, gaussians.colors.shape[1] if harmonics else 0)
    if listed is None:
        return project_in_torch(gaussians, cameras, size, options, colors)
    inputs = (*vars(gaussians).values(), cameras.extrinsics, cameras.intrinsics)
    means2d, factors, depths, alphas, rgb, radii, camera_ids, ids = _Projection.apply(*inputs, listed, harmonics)
    if colors and not harmonics:
        # camera by camera: the gradients of equal rows would be added up in any order
        rgb = torch.cat([gaussians.colors.index_select(0, part) for part in ids.split(listed.seen)])
    projected = ProjectedGaussians(
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
        num_nonfinite=listed.visible.numbers[len(cameras.extrinsics)],
        eps2d=options.eps2d,
    )
    if listed.entries is not None:
        entry_counts.remember(projected, options.alpha_threshold, *listed.entries)
    return projected


@dataclass(frozen=True, eq=False)
class _Visible:
    """Which pairs (camera, Gaussian) are visible; the tensors are those of `.projection_kernels`."""

    cameras: Tensor  # (C * WIDTH,) and more, see `.camera_kernels`
    flags: Tensor
    counts: Tensor
    numbers: Tensor


@dataclass(frozen=True, eq=False)
class _Listed:
    """The visible pairs, row by row."""

    visible: _Visible
    fields: tuple[Tensor, ...]  # means2d, factors, depths, opacities, colours and radii, without graph
    camera_ids: Tensor
    ids: Tensor
    seen: list[int]  # how many Gaussians each camera sees
    entries: tuple[Tensor, int] | None  # of one camera: how many tiles each Gaussian reaches, and their sum


def _list(
    gaussians: Gaussians, cameras: PinholeCamera, size: tuple[int, int], options: RasterOptions, bands: int
) -> _Listed | None:
    """What the cameras see; None where the kernels do not cover one of the cameras, or there are no Gaussians.

    Reads a few numbers once. One camera's list is made before, with room for all Gaussians, so that its entries are
    counted by then, too.
    """
    n = len(gaussians)
    if n == 0:
        return None
    values = _values(gaussians)
    visible = _find_visible(values, cameras, size, options)
    count = len(cameras.extrinsics)
    counts = None
    fill = partial(_fill, values, visible, options, bands)
    if count == 1:
        found = fill(n)
        counts = _count_entries(visible, found, size, options)
        *ends, _, covered, entries = visible.numbers[:4].tolist()
    else:
        *ends, _, covered = visible.numbers[: count + 2].tolist()
    if not covered:
        return None
    if counts is None:
        *fields, camera_ids, ids = fill(ends[-1])
        return _Listed(visible, tuple(fields), camera_ids, ids, [j - i for i, j in pairwise([0, *ends])], None)
    *fields, camera_ids, ids, counts = (x.resize_(ends[0], *x.shape[1:]) for x in (*found, counts))
    return _Listed(visible, tuple(fields), camera_ids, ids, ends, (counts, entries))


def _find_visible(
    values: list[Tensor], cameras: PinholeCamera, size: tuple[int, int], options: RasterOptions
) -> _Visible:
    """Find the visible pairs and number them; reads nothing."""
    means, quats, scales, opacities, colors = values
    n = len(means)
    matrices = [x.detach().contiguous() for x in (cameras.intrinsics, cameras.extrinsics)]
    count = len(matrices[0])
    among = blocks(n, _BLOCK)
    rows = means.new_empty(count * WIDTH + among)
    largest = rows[count * WIDTH :]
    flags = means.new_empty(count + 1, n, dtype=torch.int8)
    head = (count + 4) // 2 * 2  # even: pointers stay multiples of 16
    numbers = means.new_empty(head + (count + 1) * among, dtype=torch.int64)
    counts = numbers[head:]
    checked = (*values, n, len(opacities), colors.shape[1], count, among, flags, counts, largest)
    launch(check_gaussians, (among,), *checked, BLOCK=_BLOCK)
    left, top, right, bottom = options.frame or whole_frame(size)
    margins = (MARGIN * (right - left), MARGIN * (bottom - top))
    frame = (left, top, right, bottom, *margins, largest, among, float(options.alpha_threshold), rows)
    launch(describe_cameras, (count,), *matrices, *frame, BLOCK=_SUMS, warps=1)
    frustum = (rows, options.near_plane, options.eps2d, *size, n, among, flags, counts)
    launch(find_visible, (among, count), means, quats, scales, *frustum, BLOCK=_BLOCK)
    launch(number_rows, (1,), rows, count, n, among, counts, numbers, BLOCK=_SUMS)
    return _Visible(rows, flags, counts, numbers)


def _fill(values: list[Tensor], visible: _Visible, options: RasterOptions, bands: int, room: int) -> tuple[Tensor, ...]:
    """Fields, cameras and Gaussians of the visible pairs, of which there are at most as many as there is room for."""
    means, _, _, opacities, _ = values
    n = len(means)
    widths = ((2,), (2, 3), (), (), (3 if bands else 0,), ())
    fields = [means.new_empty(room, *width) for width in widths]
    ids = [visible.numbers.new_empty(room) for _ in range(2)]
    among = blocks(n, _BLOCK)
    flags = (visible.cameras, visible.flags, visible.counts)
    numbers = (options.near_plane, options.eps2d, n, among, len(opacities))
    grid = (among, len(visible.flags) - 1)
    launch(list_visible, grid, *values, *flags, *numbers, *fields, *ids, BANDS=bands, BLOCK=_BLOCK)
    return *fields, *ids


def _count_entries(
    visible: _Visible, found: tuple[Tensor, ...], size: tuple[int, int], options: RasterOptions
) -> Tensor:
    """How many tiles each row reaches; writes the sum into the numbers."""
    means2d, factors, _, opacities = found[:4]
    among = blocks(len(means2d), LANES)
    counts = visible.flags.new_empty(len(means2d), dtype=torch.int32)
    sums = visible.numbers.new_empty(among)
    threshold = entry_counts.log2_threshold(options.alpha_threshold)
    ellipses = (means2d, factors, opacities, options.eps2d, threshold, *size, blocks(size[0], SIZE))
    launch(count_all_entries, (among,), visible.numbers, *ellipses, counts, sums, BLOCK=LANES, warps=1)
    launch(sum_counts, (1,), sums, among, visible.numbers[3:], BLOCK=_SUMS)
    return counts


def _values(gaussians: Gaussians) -> list[Tensor]:
    """Means, quaternions, scales, opacities `(1, N)` or `(C, N)`, colours `(N, F)`: contiguous, without gradient."""
    *values, opacities, colors = (x.detach().contiguous() for x in vars(gaussians).values())
    wide = colors.view(len(colors), -1) if colors.numel() else colors.flatten(1)
    return [*values, opacities.view(-1, len(gaussians)), wide]


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, ...]:
        listed = arguments[7]
        return *listed.fields, listed.camera_ids, listed.ids

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        colors, listed, harmonics = inputs[4], inputs[7], inputs[8]
        ctx.save_for_backward(*inputs[:5])  # not the cameras: they may have been made in inference mode
        ctx.set_materialize_grads(False)
        ctx.visible = listed.visible
        ctx.harmonics = harmonics
        bands = colors.shape[1] if harmonics else 0
        by_mean, by_turn, by_scale, by_opacity, by_color, by_pose, by_lens = ctx.needs_input_grad[:7]
        by_position = by_mean or by_pose
        by_shape = by_position or by_lens or by_turn or by_scale
        colored = harmonics and (by_color or (by_position and bands > 1))
        differentiable = (by_position or by_lens, by_shape, by_position, by_opacity, colored, False)
        constant = [x for x, varies in zip(output[:6], differentiable, strict=True) if not varies]
        ctx.mark_non_differentiable(*constant, *output[6:])

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("project")
        inputs = ctx.saved_tensors
        means, quats, scales, opacities, colors = inputs
        visible = ctx.visible
        count = len(visible.flags) - 1
        n = len(means)
        needs = list(ctx.needs_input_grad[:7])
        needs[4] = needs[4] and ctx.harmonics
        with_camera = any(needs[5:])
        input_grads = [x.new_empty(x.shape) for x in inputs[:4]]
        input_grads.append(colors.new_empty(colors.shape if needs[4] else (0,)))  # the largest by far
        values = [x.contiguous() for x in (means, quats, scales, colors)]
        incoming = _incoming(gradients, means, ctx.harmonics)
        among = blocks(n, _BLOCK)
        totals = means.new_empty(among, 21) if with_camera else means  # to which nothing is written
        matrices = means.new_zeros(2, count, 4, 4) if with_camera else None  # poses and intrinsics
        found = (visible.cameras, visible.flags, visible.counts, n, among, opacities.numel() // n)
        for c in range(count):
            launch(
                footprint_gradients,
                (among,),
                *(c, *values, *found, *incoming, *input_grads, totals),
                BANDS=colors.shape[1] if ctx.harmonics else 0,
                WITH_DEPTHS=gradients[2] is not None,
                WITH_COLORS=needs[4],
                WITH_CAMERA=with_camera,
                ADD=c > 0,
                BLOCK=_BLOCK,
            )
            if matrices is not None:
                total = wide_sum(totals, 0).float()
                matrices[0, c, :3] = total[:12].view(3, 4)
                matrices[1, c, :3, :3] = total[12:].view(3, 3)
        found_grads = [*input_grads, *((None, None) if matrices is None else matrices)]
        return *(x if need else None for x, need in zip(found_grads, needs, strict=True)), None, None


def _incoming(gradients: tuple[Tensor | None, ...], like: Tensor, harmonics: bool) -> list[Tensor]:
    """The gradients of means2d, factors, depths, opacities and colours; what the kernel does not read is anything."""
    rows = next((len(x) for x in gradients if x is not None), 0)
    widths = ((2,), (2, 3), None, (), (3,) if harmonics else None)
    found = []
    for gradient, width in zip(gradients, widths, strict=False):
        if gradient is not None:
            found.append(gradient.contiguous())
        else:
            found.append(like if width is None else like.new_zeros(rows, *width))
    return found
