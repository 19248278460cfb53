"""Kernels are compiled side by side, before they are first launched.

Which kernels a piece of code launches, and what they are compiled for, is found by running it on the CPU without
launching. Threads are enough: Triton's compiler, the assembler and the C compiler that makes a kernel's launcher work
without Python's lock.
"""

import logging
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import torch
import triton
from torch.overrides import TorchFunctionMode

from .launch import Launch, current, recorded_launches

_EMPTY = (
    torch.empty,
    torch.empty_like,
    torch.empty_strided,
    torch.Tensor.new_empty,
    torch.Tensor.new_empty_strided,
)
_READS = (torch.Tensor.tolist, torch.Tensor.item, torch.Tensor.__int__)
_INTERVAL = 3.0  # seconds between two records of the log

_log = logging.getLogger("kgs")


def compile_ahead(run: Callable[[torch.device], object], device: torch.device) -> None:
    """Compile for a device what a piece of code launches, but for the interpreter, which compiles nothing.

    What is wrong is left to be met again when a kernel is launched.
    """
    if os.environ.get("TRITON_INTERPRET") == "1":
        return
    try:
        compile_together(needed_launches(lambda: run(torch.device("cpu"))), device)
    except Exception:
        _log.debug("kernels are compiled one after another", exc_info=True)


def needed_launches(run: Callable[[], object]) -> list[Launch]:
    """What a piece of code launches that calls kernels with tensors of a CPU; one launch of each kernel and form.

    Nothing is launched: memory that kernels fill is 0, and whole numbers that are read are at least 1.
    """
    with recorded_launches() as launches, _NothingComputed():
        run()
    return list({launch.key: launch for launch in launches}.values())


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def compile_together(launches: list[Launch], device: torch.device) -> None:
    """Compile kernels for a device in as many threads as there are cores for it, and load them there.

    A record of the log says every few seconds how far it is. A kernel that cannot be compiled is left out: an error
    says so when it is launched.
    """
    triton.runtime.driver.active.get_current_device()  # what threads share is made before them
    for launch in launches:
        launch.kernel.cache_key  # noqa: B018
    longest_first = sorted(launches, key=lambda launch: len(launch.arguments), reverse=True)
    pool = ThreadPoolExecutor(max(1, min(len(launches), cores())))
    try:
        waiting = {pool.submit(_compile, launch, device) for launch in longest_first}
        while waiting:
            _, waiting = wait(waiting, _INTERVAL)
            if waiting:
                done = len(launches) - len(waiting)
                _log.info("compiling kernels for this card, once: %d of %d", done, len(launches))
    finally:
        pool.shutdown(cancel_futures=True)


def _compile(launch: Launch, device: torch.device) -> None:
    """Compile a kernel and load it."""
    with current(device):
        compiled = launch.kernel.warmup(*launch.arguments, grid=launch.grid, **launch.options)
        compiled.run  # noqa: B018 - Triton loads it then


class _NothingComputed(TorchFunctionMode):
    """Torch on a CPU where kernels are not launched."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if func in _EMPTY:
            return found.zero_()
        return _without_zeros(found) if func in _READS else found


def _without_zeros(value: Any) -> Any:
    """A number or a nested list of numbers, with 1 for each whole number 0."""
    if isinstance(value, list):
        return [_without_zeros(x) for x in value]
    return max(value, 1) if type(value) is int else value
