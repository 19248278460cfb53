"""First-order projection of 3D Gaussians into the image, for every camera that Kornia can describe.

Source: Zwicker et al. 2001 (the affine approximation at the centre), Kerbl et al. 2023.

Gaussians nearer than the near plane, beside the image or not finite are left out before anything is divided.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from .camera import Cameras, Lens, lenses, times
from .covariance import footprint_factors, rotation_matrices, variances
from .harmonics import evaluate_harmonics
from .types import Gaussians, ProjectedGaussians, RasterOptions

Touches = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def project_torch(
    gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
) -> ProjectedGaussians:
    """`kgs.project` in torch, for every camera, device and dtype; does not check its arguments."""
    device, finite = gaussians.means.device, finite_gaussians(gaussians)
    views = lenses(cameras, size, options.frame)
    cutoff = seen_within(gaussians.opacities.detach().masked_fill(~finite, 0.0), options.alpha_threshold)
    touches, near = partial(_touches_image, size, options.eps2d, cutoff), options.near_plane
    parts = [_project_one(gaussians, c, lens, finite, touches, near, colors) for c, lens in enumerate(views)]
    counts = torch.tensor([part[0].shape[0] for part in parts], device=device)
    camera_ids = torch.repeat_interleave(torch.arange(len(parts), device=device), counts)
    joined = [field[0] if len(parts) == 1 else torch.cat(field) for field in zip(*parts, strict=True)]
    ids, means2d, factors, depths, radii, opacities, rgb = joined
    tensors = (camera_ids, ids, means2d, factors, depths, radii, opacities, rgb)
    return ProjectedGaussians(*tensors, size, len(parts), len(gaussians), (~finite).sum(), options.eps2d)


def normals(gaussians: Gaussians, cameras: Cameras, projected: ProjectedGaussians, axis: int | None = None) -> Tensor:
    """An axis of each projected Gaussian, turned towards its camera; unit vectors in world axes, `(M, 3)`.

    The axis is the local one of this number, or the shortest for None. Differentiable with respect to the quaternions.
    At right angles to the view either direction is correct.
    """
    if gaussians.quats.ndim == 3 and axis is None:
        raise ValueError("outputs: normals need quats (N, 4), got matrices, of which no column has to be an axis")
    ids = projected.gaussian_ids
    turned = rotation_matrices(gaussians.quats.index_select(0, ids))
    if axis is None:
        shortest = gaussians.scales.detach().index_select(0, ids).argmin(1)
        normal = turned.gather(2, shortest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    else:
        normal = turned[:, :, axis]
    with torch.no_grad():
        means, away = gaussians.means.index_select(0, ids), []
        for c, lens in enumerate(lenses(cameras, projected.image_size)):
            seen = _rows(means, (projected.camera_ids == c).nonzero()[:, 0])
            away.append(view_directions(seen, lens.extrinsics, lens.parallel))
        backwards = (normal * torch.cat(away)).sum(1, keepdim=True) > 0
    return torch.where(backwards, -normal, normal)


def cut_squared(opacities: Tensor, alpha_threshold: float) -> Tensor:
    """Squared Mahalanobis distance 2 ln(o / threshold) at which alpha falls to the threshold; <= 0: never reached.

    Widened by a few float32 roundings, so that what lies outside is certainly below the threshold: each pixel is then
    decided by its own alpha alone, and no image depends on the shape of tiles.
    """
    if alpha_threshold == 0:
        return torch.where(opacities > 0, torch.inf, -torch.inf).to(opacities.dtype)
    return 2.0 * torch.log(opacities.clamp_min(0.0) / alpha_threshold) + 1e-3


def _project_one(
    gaussians: Gaussians, c: int, lens: Lens, finite: Tensor, touches: Touches, near_plane: float, colors: bool
) -> tuple[Tensor, ...]:
    """The fields gaussian_ids to colors of `ProjectedGaussians` for one camera."""
    rotation, translation = lens.extrinsics[:3, :3], lens.extrinsics[:3, 3]
    with torch.no_grad():
        ids = ((times(rotation[2:], gaussians.means)[:, 0] + translation[2] > near_plane) & finite).nonzero()[:, 0]
        if lens.sees is not None:
            seen = lens.sees(times(rotation, _rows(gaussians.means, ids)) + translation)
            ids = _rows(ids, seen.nonzero()[:, 0])

    def footprints(ids: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        means = _rows(gaussians.means, ids)
        points = times(rotation, means) + translation
        rows = times(rotation.T, lens.jacobian(points))
        factors = footprint_factors(rows, _rows(gaussians.quats, ids), _rows(gaussians.scales, ids))
        return means, points, lens.project(points), factors

    means, points, means2d, factors = footprints(ids)
    with torch.no_grad():
        seen, radii, overflow = touches(means2d, factors)
        if bool(overflow.any()):  # these must not take part at all: their gradients would not be finite
            ids, seen, radii = (_rows(x, (~overflow).nonzero()[:, 0]) for x in (ids, seen, radii))
        kept = seen.nonzero()[:, 0]
    if ids.shape[0] != means.shape[0]:
        means, points, means2d, factors = footprints(ids)
    opacities = gaussians.opacities if gaussians.opacities.ndim == 1 else gaussians.opacities[c]
    ids, radii = _rows(ids, kept), _rows(radii, kept)
    rgb = _rows(gaussians.colors, ids) if colors else means.new_zeros(ids.shape[0], 0)
    if rgb.ndim == 3:
        rgb = evaluate_harmonics(rgb, view_directions(_rows(means, kept), lens.extrinsics, lens.parallel))
    projected = (_rows(x, kept) for x in (means2d, factors, points[:, 2]))
    return ids, *projected, radii, _rows(opacities, ids), rgb


def seen_within(opacities: Tensor, alpha_threshold: float) -> Tensor:
    """How many standard deviations wide a footprint counts as seen: one number for all, 0-d."""
    two = torch.full((1,), 2.0, dtype=opacities.dtype, device=opacities.device)
    largest = torch.cat([opacities.flatten(), two]).amax()
    return cut_squared(largest, alpha_threshold).clamp_min(9.0).sqrt()


def _touches_image(
    size: tuple[int, int], eps2d: float, cutoff: Tensor, means2d: Tensor, factors: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Which footprints, `cutoff` standard deviations wide, touch the image; their radii; which are not finite."""
    xx, xy, yy, det = variances(factors, eps2d)
    largest = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
    (x, y), (height, width) = means2d.unbind(1), size
    half_width, half_height = cutoff * xx.sqrt(), cutoff * yy.sqrt()
    seen = (
        (x + half_width > -0.5)
        & (x - half_width < width - 0.5)
        & (y + half_height > -0.5)
        & (y - half_height < height - 0.5)
    )
    return seen & (det > 0), torch.ceil(3.0 * largest.sqrt()), ~torch.isfinite(det + largest + x + y)


def view_directions(means: Tensor, extrinsics: Tensor, parallel: bool = False) -> Tensor:
    """Unit vectors from a camera to the Gaussians, or along its parallel rays, `(N, 3)` in world axes.

    The pose may be scaled or sheared.
    """
    inverse = _inverse(extrinsics[:3, :3])
    offsets = inverse[:, 2].expand_as(means) if parallel else means + times(inverse, extrinsics[:3, 3])
    offsets = offsets / offsets.detach().abs().amax(dim=1, keepdim=True)  # the squares of 1e20 would overflow
    unit: Tensor = offsets / torch.linalg.vector_norm(offsets, dim=1, keepdim=True)
    return unit


def _inverse(matrix: Tensor) -> Tensor:
    """The inverse of a 3x3 matrix by its cofactors; elementwise, as :func:`kgs.camera.times`."""
    scale = matrix.detach().abs().amax()  # the products of small numbers would vanish
    x, y, z = (matrix / scale).unbind()
    cofactors = torch.linalg.cross(y, z), torch.linalg.cross(z, x), torch.linalg.cross(x, y)
    determinant = (x * cofactors[0]).sum()
    if bool((scale == 0) | (determinant == 0)):  # one wait on a GPU
        raise ValueError("extrinsics: expected poses whose 3x3 block has an inverse, got one of determinant 0")
    inverse: Tensor = torch.stack(cofactors, 1) / determinant / scale
    return inverse


def finite_gaussians(gaussians: Gaussians) -> Tensor:
    """Which Gaussians have only finite parameters, `(N,)`."""
    opacities = gaussians.opacities.detach()
    values = [opacities.T if opacities.ndim == 2 else opacities[:, None]]
    values += [x.detach().flatten(1) for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.colors)]
    # a finite sum has finite terms; the slower exact test is needed only where a sum is not finite
    finite = torch.isfinite(torch.stack([x.sum(1) for x in values]).sum(0))
    if not bool(finite.all()):
        finite = torch.stack([torch.isfinite(x).all(1) for x in values]).all(0)
    return finite


def _rows(values: Tensor, ids: Tensor) -> Tensor:
    """Rows of a tensor, contiguous; no copy where all rows, in order, are wanted."""
    return values.contiguous() if ids.shape[0] == values.shape[0] else values.index_select(0, ids)
