r"""Front-to-back compositing of projected Gaussians, with an analytic backward pass.

For the layers k = 1, 2, ... of a pixel, nearest first (Kerbl et al. 2023, eq. 3)

    alpha_k = min(0.99, o_k exp(-q_k / 2)),   T_1 = 1,   T_{k+1} = T_k (1 - alpha_k),
    C = sum_k w_k c_k + T_end background,   w_k = T_k alpha_k

with alpha below `alpha_threshold` taken as 0, and T below `transmittance_stop` taken as 0 from then on. Both rules act
on each pixel and layer alone, so the image does not depend on tiles or chunks.

K consecutive entries of a tile are a chunk; the same chunk of many tiles is a step. In coordinates relative to the
tile's centre the exponent is a quadratic polynomial of the pixel, so a step is one matrix product of six coefficients
per entry with six monomials per pixel, an exponential, a scan over K, and one product with the colours. T before each
step is kept and, where memory allows, the alphas. The backward pass visits the steps from back to front and carries
V_k, the colour along g that shows from layer k on, as if no light had been lost before it:

    V_k = alpha_k (c_k . g) + (1 - alpha_k) V_{k+1},   V_end = g_T,   dL/d ln alpha_k = w_k (c_k . g - V_{k+1})

and V_{k+1} = 0 where layer k ends the light. V is a mean of colours: no sum grows large, nothing is divided by
1 - alpha. What a Gaussian gets from a tile are the six moments of that derivative over the pixels, again one matrix
product; they are shifted to its centre and summed over its tiles.

An image that needs more than `max_bytes` is made in row slices. Where lists are long, a row slice is made in depth
slices, nearest first, with lists for the tiles that still have light alone: what is hidden is not listed or sorted.
"""

import numpy as np
from torch import Tensor

from kgs.backends import choose, compiled_covers, register
from kgs.types import Composited, ProjectedGaussians, RasterOptions, check_tensor

from .torch_passes import composite_torch


def _compiled_covers(
    projected: ProjectedGaussians, features: Tensor, options: RasterOptions, _: bool, chunk_size: int | None
) -> bool:
    narrow = projected.image_size[1] <= 2**18 - 8  # columns of tiles, and how many, are numbers of 15 bits there
    return compiled_covers(features) and options.tile_size == 8 and chunk_size is None and narrow


register("compositing", "torch", composite_torch)
register("compositing", "numba", "kgs.raster.compiled_passes:composite_compiled", _compiled_covers)


def composite(  # noqa: D417 - options are described in one place
    projected: ProjectedGaussians,
    features: Tensor,
    *,
    tile_size: int = RasterOptions.tile_size,
    alpha_threshold: float = RasterOptions.alpha_threshold,
    transmittance_stop: float = RasterOptions.transmittance_stop,
    median_depth: bool = False,
    max_bytes: int = RasterOptions.max_bytes,
    chunk_size: int | None = None,
    backend: str = "auto",
) -> Composited:
    """Composite features of projected Gaussians over all pixels of all cameras.

    Differentiable once, by `backward`, with respect to `features` and `projected.means2d`, `factors` and `opacities`.
    For tile_size, alpha_threshold, transmittance_stop and max_bytes see :class:`kgs.RasterOptions`.

    Args:
        projected: M visible pairs (camera, Gaussian).
        features: what to accumulate, `(M, F)`: colours, depths, anything.
        median_depth: also find the depth at which T falls below one half.
        chunk_size: entries of a tile per step; None chooses by the length of the lists.
        backend: "auto", or the name of one, see `kgs.backends`.

    Returns:
        Features `(C, F, H, W)` without background, transmittance and median depth (or None), each `(C, 1, H, W)`.

    Raises:
        TypeError: an argument has another type, dtype or device.
        ValueError: an option is out of range, shapes do not fit, or one row of tiles alone exceeds `max_bytes`.

    Examples:
        >>> import torch, kgs
        >>> gaussians = kgs.Gaussians(
        ...     means=torch.tensor([[0.0, 0.0, 2.0]]), quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.2), opacities=torch.tensor([0.9]), colors=torch.zeros(1, 3))
        >>> k = torch.tensor([[20.0, 0.0, 15.5], [0.0, 20.0, 11.5], [0.0, 0.0, 1.0]])
        >>> projected = kgs.project(gaussians, kgs.cameras(torch.eye(4), k, width=32, height=24))
        >>> kgs.composite(projected, torch.rand(len(projected), 8)).features.shape
        torch.Size([1, 8, 24, 32])
    """
    options = RasterOptions(
        tile_size=tile_size, alpha_threshold=alpha_threshold, transmittance_stop=transmittance_stop, max_bytes=max_bytes
    )
    if chunk_size is not None and (not isinstance(chunk_size, int | np.integer) or chunk_size < 1):
        raise ValueError(f"chunk_size: expected an integer >= 1 or None, got {chunk_size}")
    if not isinstance(projected, ProjectedGaussians):
        raise TypeError(f"projected: expected kgs.ProjectedGaussians, got {type(projected).__name__}")
    check_tensor("features", features)
    shape, like = tuple(features.shape), projected.means2d
    if len(shape) != 2 or shape[0] != len(like):
        raise ValueError(f"features: expected shape ({len(like)}, F), a row per projected Gaussian, got {shape}")
    for name, value in (("factors", projected.factors), ("opacities", projected.opacities), ("features", features)):
        if len(value) != len(like) or (value.dtype, value.device) != (like.dtype, like.device):
            want, got = (f"{len(x)} rows of {x.dtype} on {x.device}" for x in (like, value))
            raise TypeError(f"{name}: expected {want} as means2d, got {got}")
    run = choose("compositing", backend, projected, features, options, median_depth, chunk_size)
    result: Composited = run(projected, features, options, median_depth, chunk_size)
    return result
