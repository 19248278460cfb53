"""Blending with a background by the kernels: with constant colours; others go to torch."""

from typing import Any

import torch
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative
from kgs.backends.torch.blending import blend as blend_in_torch

from .blending_kernels import blend_color, color_gradient
from .launch import blocks, launch

_BLOCK = 256  # pixels of a program


def blend(image: Tensor, transmittance: Tensor, background: Tensor) -> Tensor:
    """The image over a background, by a kernel where that is one colour for each image."""
    color = (image.shape[1], 1, 1)
    if tuple(background.shape) not in (color, (len(image), *color)) or background.requires_grad:
        return blend_in_torch(image, transmittance, background)
    blended: Tensor = _OverColor.apply(image, transmittance, background)
    return blended


class _OverColor(torch.autograd.Function):
    """Over one colour `(D, 1, 1)`, or one for each image, `(C, D, 1, 1)`."""

    @staticmethod
    def forward(image: Tensor, transmittance: Tensor, color: Tensor) -> Tensor:
        image, transmittance, color = (x.contiguous() for x in (image, transmittance, color))
        blended = torch.empty_like(image)
        launch(blend_color, _grid(image), image, transmittance, color, *_sizes(image, color), blended, BLOCK=_BLOCK)
        return blended

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("background")
        if not ctx.needs_input_grad[1]:
            return grad, None, None
        transmittance, color = (x.contiguous() for x in ctx.saved_tensors)
        by_transmittance = torch.empty_like(transmittance)
        given = (grad.contiguous(), transmittance, color, *_sizes(grad, color))
        launch(color_gradient, _grid(grad), *given, by_transmittance, BLOCK=_BLOCK)
        return grad, by_transmittance, None


def _grid(image: Tensor) -> tuple[int, int]:
    return blocks(image.shape[2] * image.shape[3], _BLOCK), image.shape[0]


def _sizes(image: Tensor, color: Tensor) -> tuple[int, int, int]:
    """How far the colours of two images lie from each other, pixels, channels."""
    channels = image.shape[1]
    return channels if color.ndim == 4 else 0, image.shape[2] * image.shape[3], channels
