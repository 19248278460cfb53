"""Scales, opacities and harmonics of a model's parameters, and the way back; formulas as in `kgs.backends.torch`.

Arrays, for N Gaussians, REST numbers of each in `sh_rest`, and BANDS active bands, 0 where they need not be joined:

    log_scales, scales         (N, 3)
    opacity_logits, opacities  (N,)
    sh_dc, sh_rest             (N, 3) and (N, REST)
    colors                     (N, 3 BANDS), the numbers of `sh_dc`, then the first of `sh_rest`
"""

import triton
import triton.language as tl

_LARGEST_LOG: tl.constexpr = tl.constexpr(88.72283905206835)  # of the largest float32
_LOG2_E: tl.constexpr = tl.constexpr(1.4426950408889634)
_LN2_HIGH: tl.constexpr = tl.constexpr(0.693359375)  # of 9 bits: its multiples are exact
_LN2_LOW: tl.constexpr = tl.constexpr(-2.1219444005469058e-4)


@triton.jit
def _exp(x):
    """The exponential within two units in the last place, where that of `tl.exp` loses accuracy by the size of x."""
    x = tl.where(x < -110.0, -110.0, x)  # where it is 0; what is not a number stays
    whole = tl.minimum(tl.floor(x * _LOG2_E), 127.0)
    rest = x - whole * _LN2_HIGH - whole * _LN2_LOW
    return tl.exp2(rest * _LOG2_E) * tl.exp2(whole)


@triton.jit(do_not_specialize=["n"])
def activate(
    log_scales, opacity_logits, sh_dc, sh_rest, n, scales, opacities, colors,
    REST: tl.constexpr, BANDS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Exponential, sigmoid and joined harmonics of a block of Gaussians."""
    first = tl.program_id(0).to(tl.int64) * BLOCK
    lane = tl.arange(0, BLOCK)
    left = n - first
    for k in tl.static_range(3):
        i = k * BLOCK + lane
        inside = i < left * 3
        x = tl.load(log_scales + first * 3 + i, mask=inside, other=0.0)
        tl.store(scales + first * 3 + i, tl.where(x < _LARGEST_LOG, _exp(x), float("inf")), mask=inside)
    logit = tl.load(opacity_logits + first + lane, mask=lane < left, other=0.0)
    tl.store(opacities + first + lane, 1.0 / (1.0 + _exp(-logit)), mask=lane < left)
    if BANDS > 0:
        for k in range(3 * BANDS):
            i = k * BLOCK + lane
            g, j = i // (3 * BANDS), i % (3 * BANDS)
            constant = tl.load(sh_dc + (first + g) * 3 + j, mask=(g < left) & (j < 3), other=0.0)
            other = tl.load(sh_rest + (first + g) * REST + j - 3, mask=(g < left) & (j >= 3), other=0.0)
            tl.store(colors + first * (3 * BANDS) + i, tl.where(j < 3, constant, other), mask=g < left)


@triton.jit(do_not_specialize=["n"])
def activation_gradients(
    scales, opacities, g_scales, g_opacities, g_colors, n, d_log_scales, d_opacity_logits, d_sh_dc, d_sh_rest,
    WITH_SCALES: tl.constexpr, WITH_OPACITIES: tl.constexpr, REST: tl.constexpr, BANDS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """From gradients of what `activate` gives to those of the parameters, of all bands."""
    first = tl.program_id(0).to(tl.int64) * BLOCK
    lane = tl.arange(0, BLOCK)
    left = n - first
    if WITH_SCALES:
        for k in tl.static_range(3):
            i = k * BLOCK + lane
            inside = i < left * 3
            scale = tl.load(scales + first * 3 + i, mask=inside, other=0.0)
            slope = tl.load(g_scales + first * 3 + i, mask=inside, other=0.0) * scale
            tl.store(d_log_scales + first * 3 + i, tl.where(scale < float("inf"), slope, 0.0), mask=inside)
    if WITH_OPACITIES:
        opacity = tl.load(opacities + first + lane, mask=lane < left, other=0.0)
        slope = tl.load(g_opacities + first + lane, mask=lane < left, other=0.0) * (1.0 - opacity) * opacity
        tl.store(d_opacity_logits + first + lane, tl.where(opacity == opacity, slope, 0.0), mask=lane < left)
    if BANDS > 0:
        for k in tl.static_range(3):
            i = k * BLOCK + lane
            row = g_colors + (first + i // 3) * (3 * BANDS)
            tl.store(d_sh_dc + first * 3 + i, tl.load(row + i % 3, mask=i < left * 3), mask=i < left * 3)
        for k in range(REST):
            i = k * BLOCK + lane
            g, j = i // REST, i % REST
            active = (g < left) & (j < 3 * BANDS - 3)
            slope = tl.load(g_colors + (first + g) * (3 * BANDS) + 3 + j, mask=active, other=0.0)
            tl.store(d_sh_rest + first * REST + i, slope, mask=g < left)
