"""Torch's default device, which another program may have set: what kgs makes by itself is on the CPU."""

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def on_cpu() -> AbstractContextManager[Any]:
    """A context in which tensors are made on the CPU unless a device is given."""
    # the context torch.device("cpu") slows torch down, and changes how graphs are traced
    return nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu")


def cpu_by_default(function: Callable[P, R]) -> Callable[P, R]:
    """The same function, called in the context of :func:`on_cpu`."""

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        with on_cpu():
            return function(*args, **kwargs)

    return called
