"""Which implementation of the renderer runs a call: `backend=` by name, and what "auto" takes.

    "torch"   every call (`kgs.backends.pytorch`)
    "numba"   float32 on a CPU (`kgs.backends.cpu`, extra "fast")

A backend is a class with its stages as methods, see :class:`Backend`; a new one is a folder, and a line in `BACKENDS`.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from .base import Backend
from .cpu import CpuBackend
from .pytorch import TorchBackend

__all__ = ["BACKENDS", "Backend", "available", "check_backend", "choose", "resolve", "takes_kernels"]

BACKENDS: tuple[Backend, ...] = (CpuBackend(), TorchBackend())  # "auto" takes the first that covers a call


def available() -> tuple[str, ...]:
    """The names that a `backend` argument may have."""
    return ("auto", *sorted(backend.name for backend in BACKENDS))


def check_backend(name: str) -> None:
    """Raise a ValueError for a backend that does not exist, a ModuleNotFoundError for one that is not installed."""
    if name not in available():
        raise ValueError(f"backend: expected one of {available()}, got {name!r}")
    for backend in BACKENDS:
        if backend.name == name and backend.package and not backend.is_installed():
            package, extra = backend.package
            how = f'run pip install "kgs-splat[{extra}]"'
            raise ModuleNotFoundError(f'backend: "{name}" needs {package}, {how}', name=package)


def resolve(name: str, device: torch.device) -> str:
    """The name of the backend that "auto" takes for float32 on a device; other names are returned unchanged.

    Raises:
        ValueError: the backend does not exist, or it does not run on the device.
        ModuleNotFoundError: it is named and not installed.
    """
    check_backend(name)
    for backend in BACKENDS:
        if name in ("auto", backend.name) and backend.runs_on(device) and backend.is_installed():
            return backend.name
    where = next(" and ".join(backend.devices or ()) for backend in BACKENDS if backend.name == name)
    raise ValueError(f'backend: expected "auto" or "torch" on {device}, got "{name}", which runs on {where} alone')


def choose(name: str, stage: str, covers: Callable[[Backend], bool]) -> Backend:
    """The backend for a call: the first that covers it for "auto", else the one that is named.

    Args:
        name: what the user asked for.
        stage: what is to be done, for the error.
        covers: whether a backend can do the call.

    Raises:
        ValueError: the backend does not exist, or it is named and does not cover the call.
        ModuleNotFoundError: it is named and not installed.
    """
    check_backend(name)
    for backend in BACKENDS:
        if name in ("auto", backend.name) and covers(backend):
            return backend
    raise ValueError(f'backend: {name!r} does not cover this call of {stage}, expected "auto" or "torch"')


def takes_kernels(name: str, stage: str, like: Tensor) -> bool:
    """Whether a stage outside the renderer runs on numba kernels; for stages that exist in numba and torch only.

    Raises:
        ValueError: the backend does not exist, or numba is named and does not cover such a tensor.
        ModuleNotFoundError: numba is named and not installed.
    """
    check_backend(name)
    if name not in ("auto", CpuBackend.name):
        return False
    known = (CpuBackend.name, TorchBackend.name)
    return choose(name, stage, lambda backend: backend.name in known and backend.covers(like)).name == CpuBackend.name
