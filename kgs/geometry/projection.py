"""Parts of projection that the backends and outputs beside colours share.

`kgs.backends.torch.projection` combines them. The footprint is in `.covariance`, the lens in `.lenses`.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError

from .cameras import Cameras
from .covariance import compensations, reach, rotation_matrices, variances
from .lenses import lenses, times
from .types import Gaussians, ProjectedGaussians, RasterOptions


def with_options(projected: ProjectedGaussians, options: RasterOptions) -> ProjectedGaussians:
    """The visible pairs that `far_plane` and `radius_clip` leave, with the opacities of `antialiased`."""
    if options.far_plane < math.inf or options.radius_clip > 0:
        visible = projected.depths < options.far_plane
        if options.radius_clip > 0:
            xx, _, yy, _ = variances(projected.factors.detach(), options.eps2d)
            visible &= reach(xx, yy).amax(1) > options.radius_clip
        projected = _select(projected, visible.nonzero()[:, 0])
    if options.antialiased and options.eps2d > 0:
        opacities = projected.opacities * compensations(projected.factors, options.eps2d)
        projected = replace(projected, opacities=opacities)
    return projected


def _select(projected: ProjectedGaussians, rows: Tensor) -> ProjectedGaussians:
    names = ("camera_ids", "gaussian_ids", "means2d", "factors", "depths", "radii", "opacities", "colors")
    return replace(projected, **{name: getattr(projected, name).index_select(0, rows) for name in names})


def normals(gaussians: Gaussians, cameras: Cameras, projected: ProjectedGaussians) -> Tensor:
    """The shortest axis of each projected Gaussian, turned towards its camera; unit vectors in world axes, `(M, 3)`.

    Differentiable with respect to the quaternions. At right angles to the view either direction is correct.
    """
    if gaussians.quats.ndim == 3:
        raise ArgumentError("outputs", "no normals of matrices, of which no column has to be an axis")
    ids = projected.gaussian_ids
    rotations = rotation_matrices(gaussians.quats.index_select(0, ids))
    shortest = gaussians.scales.detach().index_select(0, ids).argmin(1)
    normal = rotations.gather(2, shortest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    with torch.no_grad():
        means = gaussians.means.index_select(0, ids)
        directions = []
        for c, lens in enumerate(lenses(cameras, projected.image_size)):
            visible = select_rows(means, (projected.camera_ids == c).nonzero()[:, 0])
            directions.append(view_directions(visible, lens.extrinsics, lens.parallel))
        backwards = (normal * torch.cat(directions)).sum(1, keepdim=True) > 0
    return torch.where(backwards, -normal, normal)


def cut_squared(opacities: Tensor, alpha_threshold: float) -> Tensor:
    """Squared Mahalanobis distance 2 ln(o / threshold) at which alpha falls to the threshold; <= 0: never reached.

    Widened by a few float32 roundings, so that what lies outside is certainly below the threshold: each pixel is then
    decided by its own alpha alone, and no image depends on the shape of tiles.
    """
    if alpha_threshold == 0:
        return torch.where(opacities > 0, torch.inf, -torch.inf).to(opacities.dtype)
    return 2.0 * torch.log(opacities.clamp_min(0.0) / alpha_threshold) + 1e-3


def visibility_cutoff(opacities: Tensor, alpha_threshold: float) -> Tensor:
    """The number of standard deviations within which a footprint counts as visible: one for all Gaussians, 0-d.

    At least 3, and enough for an opacity of 2 or the largest of all, if that is more.
    """
    minimum = torch.full((1,), 2.0, dtype=opacities.dtype, device=opacities.device)
    largest = torch.cat([opacities.flatten(), minimum]).amax()
    return cut_squared(largest, alpha_threshold).clamp_min(9.0).sqrt()


def view_directions(means: Tensor, extrinsics: Tensor, parallel: bool = False) -> Tensor:
    """Unit vectors from a camera to the Gaussians, or along its parallel rays, `(N, 3)` in world axes.

    The pose may be scaled or sheared.
    """
    inverse = _inverse(extrinsics[:3, :3])
    offsets = inverse[:, 2].expand_as(means) if parallel else means + times(inverse, extrinsics[:3, 3])
    offsets = offsets / offsets.detach().abs().amax(dim=1, keepdim=True)  # else the squares of 1e20 overflow
    unit: Tensor = offsets / torch.linalg.vector_norm(offsets, dim=1, keepdim=True)
    return unit


def _inverse(matrix: Tensor) -> Tensor:
    """The inverse of a 3x3 matrix by its cofactors; elementwise, as :func:`kgs.geometry.lenses.times`."""
    scale = matrix.detach().abs().amax()  # the products of small numbers would vanish
    x, y, z = (matrix / scale).unbind()
    cofactors = (torch.linalg.cross(y, z), torch.linalg.cross(z, x), torch.linalg.cross(x, y))
    determinant = (x * cofactors[0]).sum()
    if bool((scale == 0) | (determinant == 0)):  # one wait on a GPU
        raise ArgumentError("extrinsics", "poses whose 3x3 block has an inverse", "one of determinant 0")
    inverse: Tensor = torch.stack(cofactors, 1) / determinant / scale
    return inverse


def finite_gaussians(gaussians: Gaussians) -> Tensor:
    """Whether all parameters of a Gaussian are finite, `(N,)`."""
    opacities = gaussians.opacities.detach()
    values = [opacities.T if opacities.ndim == 2 else opacities[:, None]]
    values += [x.detach().flatten(1) for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.colors)]
    # a finite sum has finite terms; the slower exact test is needed only where a sum is not finite
    finite = torch.isfinite(torch.stack([x.sum(1) for x in values]).sum(0))
    if not bool(finite.all()):
        finite = torch.stack([torch.isfinite(x).all(1) for x in values]).all(0)
    return finite


def select_rows(values: Tensor, ids: Tensor) -> Tensor:
    """Rows of a tensor, contiguous; `ids` ascend, so that as many as there are rows are all of them: no copy."""
    return values.contiguous() if ids.shape[0] == values.shape[0] else values.index_select(0, ids)
