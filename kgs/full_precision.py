"""Matrix products in the full precision of their dtype, forward and backward, whatever the program has allowed.

`torch.autocast` makes them bfloat16. `torch.set_float32_matmul_precision` lets float32 ones be rounded to TF32 or
bfloat16 where the processor has units for these: a relative error of 4e-3, two pixels at column 500. Both also act on
the backward formulas of torch's own products.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

__all__ = ["full_precision", "in_full_precision"]

_lock = threading.Lock()
_inside = 0
_put_back: Callable[[], None]  # set by who enters first


@contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """No autocast on `device` and no rounded float32 products inside; both are as before afterwards.

    Autocast is a state of the thread, the precision of products one of the process: the first thread that enters
    changes it, the last that leaves puts it back.
    """
    global _inside, _put_back
    with _lock:
        if _inside == 0:
            _put_back = _forbid_rounding()
        _inside += 1
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        with _lock:
            _inside -= 1
            if _inside == 0:
                _put_back()


def in_full_precision(function: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
    """`function(*inputs)`, differentiated in full precision as well.

    Torch's own backward formulas obey what is set when `backward` runs, so the function is called again there.

    Args:
        function: of tensors alone, to one tensor; cheap.
        inputs: on one device.
    """
    result: Tensor = _InFullPrecision.apply(function, *inputs)
    return result


class _InFullPrecision(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, function: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
        ctx.function = function
        ctx.save_for_backward(*inputs)
        with full_precision(inputs[0].device):
            return function(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[1:]
        with full_precision(grad.device), torch.enable_grad():
            inputs = [x.detach().requires_grad_(n) for x, n in zip(ctx.saved_tensors, needed, strict=True)]
            result = ctx.function(*inputs)
            found = iter(torch.autograd.grad(result, [x for x in inputs if x.requires_grad], grad))
        return None, *(next(found) if n else None for n in needed)


def _forbid_rounding() -> Callable[[], None]:
    """Full precision for the process; returns what puts the setting back."""
    if not hasattr(torch.backends.mkldnn, "matmul"):  # torch before 2.9 has one setting for all backends
        before = torch.get_float32_matmul_precision()
        torch.set_float32_matmul_precision("highest")
        return lambda: torch.set_float32_matmul_precision(before)
    changed = []
    for backend in (torch.backends.mkldnn.matmul, torch.backends.cuda.matmul):
        precision = backend.fp32_precision
        if precision not in ("none", "ieee"):
            backend.fp32_precision = "none"  # what it has now comes from torch.backends.fp32_precision
            changed.append((backend, "none" if backend.fp32_precision == precision else precision))
            backend.fp32_precision = "ieee"

    def put_back() -> None:
        for backend, precision in changed:
            backend.fp32_precision = precision

    return put_back
