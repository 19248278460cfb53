"""An image over a background in torch."""

from typing import Any

import torch
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative
from kgs._support.memory import empty


def blend(image: Tensor, transmittance: Tensor, background: Tensor) -> Tensor:
    """The image over a background of any shape."""
    if background.device.type != "cpu" or bool(background.isinf().any()):  # elsewhere the answer would be waited for
        # 0 where nothing shines through: 0 times an infinite background would be NaN
        background = torch.where(background.isinf() & (transmittance == 0), 0.0, background)
    one_color = background.ndim == 3 and background.shape[1:] == (1, 1)
    if one_color and not background.requires_grad and not torch.compiler.is_compiling():
        blended: Tensor = _OverColor.apply(image, transmittance, background[:, 0, 0])
        return blended
    return torch.addcmul(image, transmittance, background)


class _OverColor(torch.autograd.Function):
    """`addcmul` with one colour `(D,)`, with the same bits, in memory of `kgs._support.memory`."""

    @staticmethod
    def forward(image: Tensor, transmittance: Tensor, color: Tensor) -> Tensor:
        blended = empty(tuple(image.shape), image)
        return torch.addcmul(image, transmittance, color[:, None, None], out=blended)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(inputs[2])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("background")
        (color,) = ctx.saved_tensors
        by_transmittance = None
        if ctx.needs_input_grad[1]:
            product = empty(tuple(grad.shape), grad)  # no matrix product: torch may round these
            by_transmittance = torch.mul(grad, color[:, None, None], out=product).sum(1, keepdim=True)
        return grad, by_transmittance, None
