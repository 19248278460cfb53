"""Finds numbers of a fit that are not finite or explode, and names the parameter and the Gaussian."""

import math

import torch
from torch import Tensor

from kgs.model import GaussianModel

# of a scale, in extents of the camera rig: a larger one means that the fit explodes, a hundred times in a few steps
_LARGEST = 1e6
_BOUND = 1e4  # extents: no photo tells a larger scale from this one


def parameter_fault(model: GaussianModel) -> str:
    """The first parameter that is NaN, infinite, or overflows when it is activated, in words, or "" if all is well."""
    for name, parameter in model.per_gaussian().items():
        row = _first_row(~torch.isfinite(parameter.detach().exp() if name == "log_scales" else parameter.detach()))
        if row is not None:
            return f"expected finite parameters, got {parameter[row].tolist()} in {name} of Gaussian {row}"
    return ""


def step_fault(model: GaussianModel, num_nonfinite: Tensor, loss: float) -> str:
    """What made the renderer skip Gaussians, or a loss that is NaN or infinite, in words, or "" if all is well."""
    fault = parameter_fault(model) if int(num_nonfinite) else ""
    return fault or ("" if math.isfinite(loss) else f"expected a finite loss, got {loss}")


def gradient_fault(model: GaussianModel) -> str:
    """The first gradient whose square, which Adam keeps, overflows (above 1e19), in words, or "" if all is well."""
    for name, parameter in model.per_gaussian().items():
        if parameter.grad is None:
            continue
        flat = parameter.grad.flatten()
        if not math.isfinite(float(torch.dot(flat, flat))):  # allocates no tensor of squares
            row = _first_row(~torch.isfinite(parameter.grad.square()))
            whose = "all Gaussians together" if row is None else f"Gaussian {row}"
            largest = float(parameter.grad.abs().max())
            return f"expected gradients below 1e19, got up to {largest:g} in {name} of {whose}"
    return ""


def scale_fault(model: GaussianModel, extent: float) -> str:
    """The first scale above a million extents, in words, or "" if all is well."""
    row = _first_row(model.log_scales.detach() > math.log(_LARGEST * extent))
    if row is None:
        return ""
    largest = float(model.log_scales.detach()[row].max())
    return f"expected scales below {_LARGEST:g} times the extent, got e^{largest:.1f} in log_scales of Gaussian {row}"


@torch.no_grad()
def bound_scales(model: GaussianModel, extent: float) -> None:
    """Limit scales to ten thousand extents.

    An axis along the rays, or across the whole sky, changes no pixel as it grows, and Adam's steps do not become small
    with their gradient: in a long fit its scale would grow without end.
    """
    model.log_scales.clamp_(max=math.log(_BOUND * extent))


def _first_row(is_wrong: Tensor) -> int | None:
    rows = is_wrong.nonzero()
    return int(rows[0, 0]) if len(rows) else None
