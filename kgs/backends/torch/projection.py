"""Projection in torch, for every camera, device and dtype; the formulas are in `kgs.geometry`.

Source: Zwicker et al. 2001 (the affine approximation at the centre), Kerbl et al. 2023.

Gaussians nearer than the near plane, beside the image or not finite are left out before anything is divided.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from kgs.geometry.cameras import Cameras
from kgs.geometry.covariance import footprint_factors, variances
from kgs.geometry.harmonics import evaluate_harmonics
from kgs.geometry.lenses import Lens, lenses, times
from kgs.geometry.projection import finite_gaussians, select_rows, view_directions, visibility_cutoff
from kgs.geometry.types import Gaussians, ProjectedGaussians, RasterOptions


def project(
    gaussians: Gaussians, cameras: Cameras, size: tuple[int, int], options: RasterOptions, colors: bool
) -> ProjectedGaussians:
    """Gaussians as all cameras see them, through any lens."""
    device = gaussians.means.device
    finite = finite_gaussians(gaussians)
    views = lenses(cameras, size, options.frame)
    opacities = gaussians.opacities.detach().masked_fill(~finite, 0.0)
    frustum = _Frustum(size, options.near_plane, options.eps2d, visibility_cutoff(opacities, options.alpha_threshold))
    parts = [_project_one(gaussians, c, lens, finite, frustum, colors) for c, lens in enumerate(views)]
    counts = torch.tensor([part[0].shape[0] for part in parts], device=device)
    camera_ids = torch.repeat_interleave(torch.arange(len(parts), device=device), counts)
    joined = [field[0] if len(parts) == 1 else torch.cat(field) for field in zip(*parts, strict=True)]
    ids, means2d, factors, depths, radii, opacities, rgb = joined
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
        num_cameras=len(parts),
        num_gaussians=len(gaussians),
        num_nonfinite=(~finite).sum(),
        eps2d=options.eps2d,
    )


@dataclass(frozen=True, eq=False)
class _Frustum:
    """What makes a Gaussian visible."""

    size: tuple[int, int]  # of the image, height and width in pixels
    near_plane: float  # world units
    eps2d: float  # px^2
    cutoff: Tensor  # 0-d, how many standard deviations wide a footprint counts

    def touch(self, means2d: Tensor, factors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Which footprints touch the image; their radii; which are not finite."""
        height, width = self.size
        x, y = means2d.unbind(1)
        xx, xy, yy, det = variances(factors, self.eps2d)
        largest = 0.5 * (xx + yy) + torch.hypot(0.5 * (xx - yy), xy)
        half_width = self.cutoff * xx.sqrt()
        half_height = self.cutoff * yy.sqrt()
        touching = (
            (x + half_width > -0.5)
            & (x - half_width < width - 0.5)
            & (y + half_height > -0.5)
            & (y - half_height < height - 0.5)
        )
        radii = torch.ceil(3.0 * largest.sqrt())
        overflows = ~torch.isfinite(det + largest + x + y)
        return touching & (det > 0), radii, overflows


def _project_one(
    gaussians: Gaussians, c: int, lens: Lens, finite: Tensor, frustum: _Frustum, colors: bool
) -> tuple[Tensor, ...]:
    """The fields gaussian_ids to colors of `ProjectedGaussians` for one camera."""
    rotation = lens.extrinsics[:3, :3]
    translation = lens.extrinsics[:3, 3]
    with torch.no_grad():
        depths = times(rotation[2:], gaussians.means)[:, 0] + translation[2]
        ids = ((depths > frustum.near_plane) & finite).nonzero()[:, 0]
        if lens.in_view is not None:
            inside = lens.in_view(times(rotation, select_rows(gaussians.means, ids)) + translation)
            ids = select_rows(ids, inside.nonzero()[:, 0])

    def footprints(ids: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        means = select_rows(gaussians.means, ids)
        points = times(rotation, means) + translation
        rows = times(rotation.T, lens.jacobian(points))
        factors = footprint_factors(rows, select_rows(gaussians.quats, ids), select_rows(gaussians.scales, ids))
        return means, points, lens.project(points), factors

    means, points, means2d, factors = footprints(ids)
    with torch.no_grad():
        visible, radii, overflows = frustum.touch(means2d, factors)
        if bool(overflows.any()):  # these must not take part at all: their gradients would not be finite
            ids, visible, radii = (select_rows(x, (~overflows).nonzero()[:, 0]) for x in (ids, visible, radii))
        visible_rows = visible.nonzero()[:, 0]
    if ids.shape[0] != means.shape[0]:
        means, points, means2d, factors = footprints(ids)
    opacities = gaussians.opacities if gaussians.opacities.ndim == 1 else gaussians.opacities[c]
    ids = select_rows(ids, visible_rows)
    radii = select_rows(radii, visible_rows)
    rgb = select_rows(gaussians.colors, ids) if colors else means.new_zeros(ids.shape[0], 0)
    if rgb.ndim == 3:
        directions = view_directions(select_rows(means, visible_rows), lens.extrinsics, lens.parallel)
        rgb = evaluate_harmonics(rgb, directions)
    means2d, factors, depths = (select_rows(x, visible_rows) for x in (means2d, factors, points[:, 2]))
    return ids, means2d, factors, depths, radii, select_rows(opacities, ids), rgb
