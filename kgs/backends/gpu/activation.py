"""The activations by the kernels, one forward and one backward."""

from typing import Any

import torch
from torch import Tensor

from kgs._support.autograd import refuse_second_derivative

from .activation_kernels import activate as activate_all
from .activation_kernels import activation_gradients
from .launch import blocks, launch

_BLOCK = 256  # Gaussians of a program


def activate(
    log_scales: Tensor, opacity_logits: Tensor, sh_dc: Tensor, sh_rest: Tensor, bands: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Scales, opacities and harmonics, in one launch."""
    if bands > 1:
        scales, opacities, colors = _Activation.apply(log_scales, opacity_logits, sh_dc, sh_rest, bands)
        return scales, opacities, colors
    scales, opacities = _Activation.apply(log_scales, opacity_logits, None, None, 0)
    return scales, opacities, sh_dc


class _Activation(torch.autograd.Function):
    """Scales and opacities; and colours, where there are harmonics to be joined."""

    @staticmethod
    def forward(
        log_scales: Tensor, opacity_logits: Tensor, sh_dc: Tensor | None, sh_rest: Tensor | None, bands: int
    ) -> tuple[Tensor, ...]:
        inputs = [x.contiguous() for x in (log_scales, opacity_logits, sh_dc, sh_rest) if x is not None]
        n = len(log_scales)
        outputs = [torch.empty_like(x) for x in inputs[:2]]
        if sh_rest is not None:
            outputs.append(inputs[3].new_empty(n, bands, 3))
        nothing = outputs[:1]  # in place of tensors of harmonics: the kernel does not touch it
        rest = 0 if sh_rest is None else 3 * sh_rest.shape[1]
        arguments = (*(inputs + 2 * nothing)[:4], n, *(outputs + nothing)[:3])
        launch(activate_all, (blocks(n, _BLOCK),), *arguments, REST=rest, BANDS=bands, BLOCK=_BLOCK)
        return tuple(outputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*output[:2])
        ctx.rest_shape = None if inputs[3] is None else inputs[3].shape

    @staticmethod
    def backward(
        ctx: Any, by_scale: Tensor | None, by_opacity: Tensor | None, by_color: Tensor | None = None
    ) -> tuple[Tensor | None, ...]:
        refuse_second_derivative("model")
        scales, opacities = ctx.saved_tensors
        n = len(scales)
        needs = ctx.needs_input_grad
        with_scales = by_scale is not None and needs[0]
        with_opacities = by_opacity is not None and needs[1]
        with_colors = by_color is not None and any(needs[2:])
        d_log_scales = torch.empty_like(scales) if with_scales else None
        d_opacity_logits = torch.empty_like(opacities) if with_opacities else None
        d_sh_dc = scales.new_empty(n, 1, 3) if with_colors else None
        d_sh_rest = scales.new_empty(ctx.rest_shape) if with_colors else None
        incoming = [scales if x is None else x.contiguous() for x in (by_scale, by_opacity, by_color)]
        found = (d_log_scales, d_opacity_logits, d_sh_dc, d_sh_rest)
        launch(
            activation_gradients,
            (blocks(n, _BLOCK),),
            *(scales, opacities, *incoming, n, *(scales if x is None else x for x in found)),
            WITH_SCALES=with_scales,
            WITH_OPACITIES=with_opacities,
            REST=3 * ctx.rest_shape[1] if with_colors else 0,
            BANDS=by_color.shape[1] if with_colors and by_color is not None else 0,
            BLOCK=_BLOCK,
        )
        return *found, None
