"""Images over a colour, and the way back.

Arrays, for C images of P pixels and D channels:

    image, blended, grad             (C, D, P)
    transmittance, by_transmittance  (C, P)
    color                            (C, D), or (D,) for all images: then `stride` is 0
"""

import triton
import triton.language as tl


@triton.jit
def _color(color, transmittance):
    """A channel of the colour in each pixel: 0 for an infinite one where nothing shines through."""
    return tl.where(transmittance == 0.0, tl.where(tl.abs(color) == float("inf"), 0.0, color), color)


@triton.jit(do_not_specialize=["stride", "pixels", "channels"])
def blend_color(image, transmittance, color, stride, pixels, channels, blended, BLOCK: tl.constexpr):
    """The image plus the transmittance times the colour."""
    c = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < pixels
    share = tl.load(transmittance + c * pixels + p, mask=inside, other=0.0)
    at = c * channels * pixels + p
    d = 0
    while d < channels:
        value = tl.load(image + at, mask=inside, other=0.0) + share * _color(tl.load(color + c * stride + d), share)
        tl.store(blended + at, value, mask=inside)
        at += pixels
        d += 1


@triton.jit(do_not_specialize=["stride", "pixels", "channels"])
def color_gradient(grad, transmittance, color, stride, pixels, channels, by_transmittance, BLOCK: tl.constexpr):
    """From the gradient of the image to that of the transmittance."""
    c = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = p < pixels
    share = tl.load(transmittance + c * pixels + p, mask=inside, other=0.0)
    at = c * channels * pixels + p
    total = share * 0.0
    d = 0
    while d < channels:
        total += tl.load(grad + at, mask=inside, other=0.0) * _color(tl.load(color + c * stride + d), share)
        at += pixels
        d += 1
    tl.store(by_transmittance + c * pixels + p, total, mask=inside)
