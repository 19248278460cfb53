"""`gsplat.rasterization` on kgs: the same arguments, order and results, for trainers that are written for gsplat."""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs.backends import Backend, get_backend
from kgs.projection import normals
from kgs.renderer import blend
from kgs.stages import project, rasterize
from kgs.types import ProjectedGaussians, RasterOptions, check_tensor

from .arguments import check_words, refuse
from .meta import Pairs, absgrad_hook, joined
from .scenes import Scene, batch_shape, split

_FAR = 1e10  # gsplat's default far plane, which means none


def rasterization(  # noqa: D417 - arguments without effect are described together
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = RasterOptions.near_plane,
    far_plane: float = _FAR,
    radius_clip: float = RasterOptions.radius_clip,
    eps2d: float = RasterOptions.eps2d,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int | None = RasterOptions.tile_size,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    macro_tile: bool = False,
    return_normals: bool = False,
    global_z_order: bool = True,
    rays: Tensor | None = None,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    lidar_coeffs: Any = None,
    external_distortion_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    ut_params: Any = None,
    extra_signals: Tensor | None = None,
    extra_signals_sh_degree: int | None = None,
    renderer_config: Any = None,
    *,
    channel_chunk: int = 32,
    pixel_centers: str = "half",
    alpha_threshold: float = RasterOptions.alpha_threshold,
    transmittance_stop: float = RasterOptions.transmittance_stop,
    max_bytes: int | None = RasterOptions.max_bytes,
    backend: str | Backend = "auto",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians in C cameras; a drop-in for `gsplat.rasterization` of gsplat 1.6, and of 1.5 by name.

    Differentiable in all tensors, `viewmats` and `Ks` included. Leading dimensions `...` are scenes of their own, of N
    Gaussians and C cameras each. For near_plane, radius_clip, eps2d, alpha_threshold, transmittance_stop and max_bytes
    see :class:`kgs.RasterOptions`.

    tile_size, segmented, macro_tile, channel_chunk, ut_params and renderer_config change nothing. sparse_grad,
    distributed, with_ut, with_eval3d, global_z_order, rays, radial_coeffs, tangential_coeffs, thin_prism_coeffs,
    ftheta_coeffs, lidar_coeffs, external_distortion_coeffs, rolling_shutter, viewmats_rs and extra_signals_sh_degree
    are accepted only at gsplat's defaults. The page "Coming from gsplat" has the differences, argument by argument.

    Convention:
        World-to-camera matrices, OpenCV axes; quaternions w, x, y, z; the first pixel's centre at (0.5, 0.5).

    Args:
        means: centres in world units, `(..., N, 3)`.
        quats: of any norm from 1e-38 on, `(..., N, 4)`; None where `covars` are given.
        scales: standard deviations in world units, > 0, `(..., N, 3)`; None where `covars` are given.
        opacities: in [0, 1], `(..., N)`, or `(..., C, N)` for one value per camera.
        colors: without `sh_degree` any features, `(..., N, D)` or `(..., C, N, D)`; with it harmonics `(..., N, K, 3)`,
            or `(N, K, 3)` for all scenes. May be None where `render_mode` is "D" or "ED".
        viewmats: `(..., C, 4, 4)`.
        Ks: intrinsics in pixels, `(..., C, 3, 3)`; skew is followed by pinhole cameras alone.
        width: of the images in pixels.
        height: of the images in pixels.
        far_plane: Gaussians with z >= far_plane are left out; 1e10 or more: none are.
        sh_degree: degree 0 to 3 of the harmonics to use; K is at least (sh_degree + 1)^2. None: `colors` as they are.
        packed: the layout of `meta`, see below; it changes nothing else.
        backgrounds: `(..., C, D)`, or None for 0; with extra signals `(..., C, D + E)`. Not used without colours.
        render_mode: "RGB" (the colours), "D" (sum of w z), "ED" (that over alpha), "RGB+D" or "RGB+ED".
        absgrad: `backward` also sets `meta["means2d"].absgrad`, see :class:`kgs.RasterOptions`.
        rasterize_mode: "classic", or "antialiased": see :class:`kgs.RasterOptions`.
        camera_model: "pinhole", "fisheye" (equidistant) or "ortho".
        covars: covariances in place of `quats` and `scales`, `(..., N, 3, 3)`: their upper triangles, see
            :func:`kgs.covariance.covariance_factors`.
        return_normals: `meta["normals"]` are the sums of w times normal, `(..., C, H, W, 3)`; the normal is the third
            local axis, turned towards the camera, in world axes.
        extra_signals: more features, `(..., N, E)` or `(..., C, N, E)`, rendered into `meta["render_extra_signals"]`.
        pixel_centers: "half" as in gsplat, or "integer": the first pixel's centre at (0, 0).
        backend: "auto", "torch", or in float32 "numba" (on a CPU) or "triton" (on a GPU), see `kgs.backends`.

    Returns:
        Renders `(..., C, H, W, D)`, where a depth is the last channel; alphas `(..., C, H, W, 1)`; and a dict `meta`.
        Of the M visible pairs (camera, Gaussian) it has depths and opacities `(M,)`; means2d `(M, 2)` in the
        pixels of `Ks`, whose gradient `retain_grad()` keeps, as in gsplat; radii `(M, 2)`, int32, 3.33 standard
        deviations along x and y in pixels, rounded up; conics `(M, 3)`; batch_ids, camera_ids and gaussian_ids `(M,)`.
        With `packed=False` they are `(..., C, N)` and so on, 0 where a Gaussian is not visible, and the ids are None.
        Also width, height, tile_size, tile_width, tile_height, n_batches and n_cameras.

    Raises:
        TypeError: an argument is not a tensor, or of another dtype or device.
        ValueError: shapes do not match, an option is out of range, or kgs does not do what is asked for.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.

    Examples:
        >>> import torch, kgs
        >>> k = torch.tensor([[[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]]])
        >>> renders, alphas, meta = kgs.rasterization(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.2), opacities=torch.tensor([0.9]), colors=torch.rand(1, 5),
        ...     viewmats=torch.eye(4)[None], Ks=k, width=32, height=24, render_mode="RGB+ED")
        >>> renders.shape, alphas.shape, meta["means2d"].tolist()
        (torch.Size([1, 24, 32, 6]), torch.Size([1, 24, 32, 1]), [[16.0, 12.0]])
    """
    check_words(render_mode, rasterize_mode, camera_model)
    refuse(
        sparse_grad=sparse_grad,
        distributed=distributed,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        global_z_order=global_z_order,
        rays=rays,
        radial_coeffs=radial_coeffs,
        tangential_coeffs=tangential_coeffs,
        thin_prism_coeffs=thin_prism_coeffs,
        ftheta_coeffs=ftheta_coeffs,
        lidar_coeffs=lidar_coeffs,
        external_distortion_coeffs=external_distortion_coeffs,
        rolling_shutter=rolling_shutter,
        viewmats_rs=viewmats_rs,
        extra_signals_sh_degree=extra_signals_sh_degree,
    )
    if return_normals and covars is not None:
        raise ArgumentError("return_normals", "False where covars are given, they have no third axis")
    options = RasterOptions(
        tile_size=tile_size,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        antialiased=rasterize_mode == "antialiased",
        alpha_threshold=alpha_threshold,
        transmittance_stop=transmittance_stop,
        max_bytes=max_bytes,
        absgrad=absgrad,
    )
    endless = options.far_plane >= _FAR
    options = dataclasses.replace(options, tile_size=None, far_plane=math.inf if endless else options.far_plane)
    image = "RGB" in render_mode
    if image:
        check_tensor("colors", colors)
    else:
        colors = None
        sh_degree = None
        backgrounds = None
    shape = batch_shape(means, viewmats)
    batch, count, n = shape
    views = (viewmats, Ks, (height, width), camera_model, pixel_centers, shape)
    scenes = split(means, quats, scales, covars, opacities, colors, extra_signals, sh_degree, *views)
    table = get_backend(backend, means.device)
    projected = [project(s.gaussians, s.cameras, options=options, colors=bool(s.widths), backend=table) for s in scenes]
    pairs = Pairs(projected, batch, count, n, packed)
    half = 0.5 if pixel_centers == "half" else 0.0
    means2d = pairs.spread(joined([p.means2d for p in projected]) + half)
    composited = []
    for b, (scene, rows) in enumerate(zip(scenes, pairs.gathered(means2d), strict=True)):
        projected[b] = dataclasses.replace(projected[b], means2d=rows - half)
        features = _features(scene, projected[b], render_mode.endswith("D"), return_normals)
        values = torch.cat(list(features.values()), 1)
        hook = absgrad_hook(means2d, pairs.rows(b)) if absgrad else None
        composited.append(rasterize(projected[b], values, options, table, absgrad_hook=hook))
    transmittance = joined([x.transmittance for x in composited])
    widths = [x.shape[1] for x in features.values()]
    sums = dict(zip(features, joined([x.features for x in composited]).split(widths, 1), strict=True))
    images = _over(sums, transmittance, backgrounds, (*batch, count), table)
    alphas = 1.0 - transmittance
    if "depth" in sums:
        images["depth"] = sums["depth"] / alphas.clamp_min(1e-10) if render_mode.endswith("ED") else sums["depth"]

    def laid_out(x: Tensor) -> Tensor:
        channels_last: Tensor = x.permute(0, 2, 3, 1).unflatten(0, (*batch, count))
        return channels_last

    meta = pairs.meta(means2d)
    tile = composited[0].tile_size
    meta |= {"width": width, "height": height, "tile_size": tile}
    meta |= {"tile_width": -(-width // tile), "tile_height": -(-height // tile)}
    if extra_signals is not None:
        meta["render_extra_signals"] = laid_out(images["extra"])
    if return_normals:
        meta["normals"] = laid_out(sums["normal"])
    renders = torch.cat([images[name] for name in ("image", "depth") if name in images], 1)
    return laid_out(renders), laid_out(alphas), meta


def _features(scene: Scene, projected: ProjectedGaussians, depth: bool, normal: bool) -> dict[str, Tensor]:
    """The features to composite for a scene, `(M, D)` each, in this order."""
    features = scene.features_of(projected)
    if depth:
        features["depth"] = projected.depths[:, None]
    if normal:
        features["normal"] = normals(scene.gaussians, scene.cameras, projected, axis=2)
    return features


def _over(
    sums: dict[str, Tensor], transmittance: Tensor, backgrounds: Tensor | None, batch: tuple[int, ...], backend: Backend
) -> dict[str, Tensor]:
    """The image and the extra signals over their background; `batch` are the leading dimensions of `backgrounds`."""
    names = [name for name in ("image", "extra") if name in sums]
    if backgrounds is None:
        return {name: sums[name] for name in names}
    widths = [sums[name].shape[1] for name in names]
    check_tensor("backgrounds", backgrounds)
    if tuple(backgrounds.shape) != (*batch, sum(widths)):
        raise ArgumentError("backgrounds", f"shape {(*batch, sum(widths))}", tuple(backgrounds.shape))
    behind = backgrounds.reshape(-1, sum(widths))
    over = blend(torch.cat([sums[name] for name in names], 1), transmittance, behind, backend, "backgrounds")
    return dict(zip(names, over.split(widths, 1), strict=True))
