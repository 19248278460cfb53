"""Matrix products in the full precision of their dtype, forward and backward, whatever the program has allowed.

`torch.autocast` makes them bfloat16. `torch.set_float32_matmul_precision` lets float32 ones be rounded to TF32 or
bfloat16 where the processor has units for these: a relative error of 4e-3, two pixels at column 500. Both also act on
the backward formulas of torch's own products.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

_MKLDNN: Any = torch.backends.mkldnn  # without `matmul`, before torch 2.9, there is one setting for all
_BACKENDS: list[Any] = [_MKLDNN.matmul, torch.backends.cuda.matmul] if hasattr(_MKLDNN, "matmul") else []
_lock = threading.Lock()
_inside = 0
_put_back: Callable[[], None]  # set by who enters first


@contextmanager
def full_precision(device: torch.device) -> Iterator[None]:
    """No autocast on `device` (a state of the thread) and no rounded float32 products (one of the process) inside.

    The first thread that enters changes the precision of products, the last that leaves puts it back.
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
            _inside = max(_inside - 1, 0)  # a fork from within begins at 0
            if _inside == 0:
                _put_back()


def in_full_precision(function: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
    """A cheap `function(*inputs)` of tensors to a tensor, differentiated in full precision as well.

    Torch's own backward formulas obey what is set when `backward` runs, so the function is called again there.
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
        needed, again = ctx.needs_input_grad[1:], torch.is_grad_enabled()
        with full_precision(grad.device), torch.enable_grad():
            # views of the inputs where second derivatives are wanted: one input may depend on another
            pairs = list(zip(ctx.saved_tensors, needed, strict=True))
            inputs = [x.view_as(x) if again else x.detach().requires_grad_(n) for x, n in pairs]
            wanted = [x for x, n in zip(inputs, needed, strict=True) if n]
            result = ctx.function(*inputs)
            if result.requires_grad:
                options: Any = {"create_graph": again, "allow_unused": True, "materialize_grads": True}
                found = iter(torch.autograd.grad(result, wanted, grad, **options))
            else:  # Kornia's project, for one, returns early where there are no points
                found = iter([torch.zeros_like(x) for x in wanted])
        return None, *(next(found) if n else None for n in needed)


def _forbid_rounding() -> Callable[[], None]:
    """Full precision for the process; returns what puts the setting back, unless somebody has changed it meanwhile."""
    level = _level()
    settings = [] if level == "highest" else [_own_setting(backend) for backend in _BACKENDS]
    if level != "highest":
        torch.set_float32_matmul_precision("highest")

    def put_back() -> None:
        if level == "highest" or _level() != "highest":
            return
        if level is not None:
            torch.set_float32_matmul_precision(level)
        for backend, setting in zip(_BACKENDS, settings, strict=True):
            backend.fp32_precision = setting

    return put_back


def _level() -> str | None:
    """The one setting for all backends; None where they differ, which torch reports as an error."""
    try:
        return torch.get_float32_matmul_precision()
    except RuntimeError:
        return None


def _own_setting(backend: Any) -> Any:
    """What a backend was set to, "none" if it follows torch.backends.fp32_precision; it is "none" afterwards."""
    setting = backend.fp32_precision
    backend.fp32_precision = "none"
    return "none" if backend.fp32_precision == setting else setting


def _start_anew() -> None:
    """In the child of a fork, where no other thread will leave."""
    global _lock, _inside
    if _inside:
        _put_back()
    _lock, _inside = threading.Lock(), 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_anew)
