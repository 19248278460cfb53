"""How kernels are called."""

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, warps: int = 4, **constants: Any) -> None:
    """Run a kernel on the device of its first tensor; nothing is waited for.

    Args:
        kernel: of one of the modules `X_kernels`.
        grid: how many programs, along at most three axes; nothing happens where one is 0.
        arguments: of the kernel, in their order; tensors are contiguous.
        warps: of each program.
        constants: arguments that the kernel is compiled for.
    """
    if not all(grid):
        return
    first = next(x for x in arguments if isinstance(x, Tensor))
    with _current(first.device):
        # products are fused with sums, in every version of Triton: from 3.10 on it is not the default
        kernel[grid](*arguments, **constants, num_warps=warps, enable_fp_fusion=True)


def wide_sum(values: Tensor, dim: int) -> Tensor:
    """The sum along a dimension in float64; in float32 on Intel's GPUs, some of which have no float64."""
    return values.sum(dim, dtype=torch.float32 if values.device.type == "xpu" else torch.float64)


def blocks(count: int, size: int) -> int:
    """How many blocks of a size cover a count."""
    return -(-count // size)


def _current(device: torch.device) -> AbstractContextManager[Any]:
    """Makes the device the current one, where there are several of its kind: Triton launches on that one."""
    if device.type == "cpu" or device.index is None:
        return nullcontext()
    context: AbstractContextManager[Any] = torch.get_device_module(device).device(device.index)
    return context
