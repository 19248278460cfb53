"""Projection by the kernels: pinhole cameras; others go to torch."""

import math
from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative
from kgs._support.compiled.arrays import Array, arrays
from kgs._support.compiled.threads import parallel_for
from kgs._support.memory import array, empty
from kgs._support.torch_threads import thread_count
from kgs.backends.torch.projection import project as project_in_torch
from kgs.geometry.cameras import Cameras
from kgs.geometry.lenses import MARGIN, Frame, whole_frame
from kgs.geometry.projection import finite_gaussians, visibility_cutoff
from kgs.geometry.types import Gaussians, ProjectedGaussians, RasterOptions

from .camera_kernels import camera_gradients
from .projection_kernels import BLOCK, footprint_gradients, footprints


def project(
    gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
) -> ProjectedGaussians:
    """Gaussians as pinhole cameras see them, by the kernels, and through other lenses in torch."""
    if not _covers(cameras) or gaussians.quats.ndim == 3 or options.near_plane < 1e-8:  # Kornia divides by no less
        return project_in_torch(gaussians, cameras, size, options, colors)
    opacities = gaussians.opacities.detach()
    wide = bool((opacities > 2.0).any())  # only these change the cutoff
    opacities = opacities.masked_fill(~finite_gaussians(gaussians), 0.0) if wide else opacities[..., :0]
    cutoff = float(visibility_cutoff(opacities, options.alpha_threshold))
    frustum = tuple(np.float32(x) for x in (*size, options.near_plane, options.eps2d, cutoff))
    harmonics = colors and gaussians.colors.ndim == 3
    views = _views(cameras, options.frame or whole_frame(size))
    inputs = (*vars(gaussians).values(), cameras.extrinsics, cameras.intrinsics)
    fields = _Projection.apply(*inputs, views, frustum, harmonics)
    means2d, factors, depths, opacities, rgb, ids, camera_ids, radii, num_nonfinite = fields
    if colors and not harmonics:
        rgb = gaussians.colors.index_select(0, ids)
    return ProjectedGaussians(
        camera_ids,
        ids,
        means2d,
        factors,
        depths,
        radii,
        opacities,
        rgb,
        image_size=size,
        num_cameras=len(cameras.extrinsics),
        num_gaussians=len(gaussians),
        num_nonfinite=num_nonfinite,
        eps2d=options.eps2d,
    )


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(*arguments: Any) -> tuple[Tensor, ...]:
        *inputs, _, _, views, frustum, harmonics = arguments
        n = len(inputs[0])
        values = _fields(inputs)
        shapes = ((n, 2), (n, 6), (n,), (n,), (n, 3 if harmonics else 0), (n,))
        counts = np.zeros((-(-n // BLOCK), 2), np.int64)  # visible and not finite, of each block
        parts = []
        for c, view in enumerate(views):
            lists = [*(empty(shape, inputs[0]) for shape in shapes), torch.from_numpy(array(n, np.int64))]
            out = tuple(x.numpy() for x in lists)
            threads = thread_count()
            parallel_for(threads, len(counts), footprints, *values, c, view, frustum, out, counts, pieces=16)
            visible = _close_up(out, counts[:, 0])
            parts.append([x[:visible] for x in lists])
        joined = [x[0] if len(parts) == 1 else torch.cat(x) for x in zip(*parts, strict=True)]
        means2d, factors, depths, opacities, rgb, radii, ids = joined
        factors = factors.view(-1, 2, 3)
        num_nonfinite = ids.new_tensor(int(counts[:, 1].sum()))
        camera_ids = torch.from_numpy(np.repeat(np.arange(len(parts)), [len(part[-1]) for part in parts]))
        return means2d, factors, depths, opacities, rgb, ids, camera_ids, radii, num_nonfinite

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        *tensors, _, _, ctx.views, _, harmonics = inputs
        ids, camera_ids = output[5:7]
        ctx.save_for_backward(*tensors)
        counts = np.bincount(camera_ids.numpy(), minlength=len(ctx.views))
        ctx.ids = [part.numpy() for part in ids.split(counts.tolist())]
        by_mean, by_turn, by_scale, by_opacity, by_color, by_pose, by_lens = ctx.needs_input_grad[:7]
        by_position = by_mean or by_pose
        by_shape = by_position or by_lens or by_turn or by_scale
        colored = harmonics and (by_color or (by_position and tensors[4].shape[1] > 1))
        differentiable = (by_position or by_lens, by_shape, by_position, by_opacity, colored)
        constant = [x for x, varies in zip(output[:5], differentiable, strict=True) if not varies]
        ctx.mark_non_differentiable(*constant, *output[5:])

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("project")
        inputs = ctx.saved_tensors
        needs = ctx.needs_input_grad[:7]
        means, quats, scales, _, colors = _fields(inputs)
        input_grads = [empty(x.shape, x) for x in inputs]
        outs = _fields(input_grads)
        colored = needs[4] and gradients[4].shape[1] > 0
        if not colored:  # the largest by far
            outs = (*outs[:4], outs[4][:, :0])
        gradients = arrays(gradients[0], gradients[1].flatten(1), *gradients[2:5])
        poses, intrinsics = np.zeros((2, len(ctx.views), 4, 4), np.float32)
        begin = 0
        for c, (view, ids) in enumerate(zip(ctx.views, ctx.ids, strict=True)):
            own = tuple(x[begin : begin + len(ids)] for x in gradients)
            if any(needs[:5]):
                of_gaussians = (means, quats, scales, colors, c, view, ids, own, outs)
                parallel_for(thread_count(), len(means), footprint_gradients, *of_gaussians)
            if any(needs[5:]):
                rows = np.empty((len(ids), 21), np.float32)
                of_camera = (means, quats, scales, colors, view, ids, own, rows)
                parallel_for(thread_count(), len(ids), camera_gradients, *of_camera)
                total = rows.sum(0, np.float64)
                poses[c, :3] = total[:12].reshape(3, 4)
                intrinsics[c, :3, :3] = total[12:].reshape(3, 3)
            begin += len(ids)
        input_grads += [torch.from_numpy(poses), torch.from_numpy(intrinsics)]
        wanted = (*needs[:4], colored, *needs[5:])
        return *(x if want else None for x, want in zip(input_grads, wanted, strict=True)), None, None, None


def _covers(cameras: Cameras) -> TypeGuard[PinholeCamera]:
    """Whether these are pinhole cameras with finite numbers, focal lengths other than 0, and affine, invertible poses.

    The last rows of the intrinsics have been checked.
    """
    if not isinstance(cameras, PinholeCamera):
        return False
    k, pose = arrays(cameras.intrinsics, cameras.extrinsics)
    finite = np.isfinite(k).all() and np.isfinite(pose).all()
    affine = (pose[:, 3] == [0.0, 0.0, 0.0, 1.0]).all()
    return bool(finite and affine and k[:, [0, 1], [0, 1]].all() and np.linalg.det(pose[:, :3, :3]).all())


def _views(cameras: PinholeCamera, frame: Frame) -> list[tuple[Array, ...]]:
    """The cameras as the kernels take them; in NumPy, which is faster for so few numbers."""
    views = list[tuple[Array, ...]]()
    for matrix, pose in zip(*arrays(cameras.intrinsics, cameras.extrinsics), strict=True):
        focal = matrix.diagonal()[:2]
        centre = matrix[:2, 2]
        begin, end = np.array([frame[:2], frame[2:]], matrix.dtype)
        margin = MARGIN * (end - begin)
        first = -(centre - begin + margin) / focal
        last = (end - centre + margin) / focal
        limits = np.stack([np.minimum(first, last), np.maximum(first, last)], 1)  # as `tangent_limits`
        inverse = np.linalg.inv(pose[:3, :3])
        # copies: a user may change a camera in place before the backward pass
        views.append((pose[:3].copy(), matrix[:2, :3].copy(), limits, inverse, -(inverse @ pose[:3, 3])))
    return views


def _fields(tensors: Sequence[Tensor]) -> tuple[Array, ...]:
    """The memory of the fields of Gaussians, opacities as `(1, N)` or `(C, N)`, colours as `(N, F)`."""
    *first, opacities, colors = arrays(*tensors)
    return *first, np.atleast_2d(opacities), colors.reshape(len(colors), math.prod(colors.shape[1:]))


def _close_up(lists: tuple[Array, ...], counts: Array) -> int:
    """Move the rows of each block to the end of those before it; returns how many there are in all."""
    end = 0
    for block, count in enumerate(counts.tolist()):
        begin = block * BLOCK
        if begin != end:
            for x in lists:
                x[end : end + count] = x[begin : begin + count]
        end += count
    return end
