"""Where a fit leaves the finite numbers: what is wrong, and with which parameter of which Gaussian, in words."""

import math

import torch
from torch import Tensor

from kgs.model import GaussianModel

_LARGEST = 1e6  # no scale is as many extents of the camera rig, unless the fit explodes


def parameter_fault(model: GaussianModel) -> str:
    """The first parameter that is not finite, or overflows when it is activated; "" where there is none."""
    for name, parameter in model.named_parameters():
        row = _first_row(~torch.isfinite(parameter.detach().exp() if name == "log_scales" else parameter.detach()))
        if row is not None:
            return f"expected finite parameters, got others in {name} of Gaussian {row}"
    return ""


def step_fault(model: GaussianModel, num_nonfinite: Tensor, loss: float) -> str:
    """What is wrong with a render that left Gaussians out because they are not finite, or with its loss, or ""."""
    fault = parameter_fault(model) if int(num_nonfinite) else ""
    return fault or ("" if math.isfinite(loss) else f"expected a finite loss, got {loss}")


def gradient_fault(model: GaussianModel) -> str:
    """The first gradient whose square, which Adam keeps, is not finite (from 1e19 on); "" where there is none."""
    for name, parameter in model.named_parameters():
        if parameter.grad is None:
            continue
        flat = parameter.grad.flatten()
        if not math.isfinite(float(torch.dot(flat, flat))):  # without a tensor of squares
            row = _first_row(~torch.isfinite(parameter.grad.square()))
            whose = "all Gaussians together" if row is None else f"Gaussian {row}"
            return f"expected gradients below 1e19, got others in {name} of {whose}"
    return ""


def scale_fault(model: GaussianModel, extent: float) -> str:
    """The first scale above a million extents; "" where there is none."""
    row = _first_row(model.log_scales.detach() > math.log(_LARGEST * extent))
    if row is None:
        return ""
    largest = float(model.log_scales.detach()[row].max())
    return f"expected scales below {_LARGEST:g} times the extent, got e^{largest:.1f} in log_scales of Gaussian {row}"


def _first_row(is_wrong: Tensor) -> int | None:
    rows = is_wrong.nonzero()
    return int(rows[0, 0]) if len(rows) else None
