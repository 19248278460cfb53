"""Which implementation of the renderer runs a call: `backend=` by name, and what "auto" takes.

    "torch"   every call (`kgs.backends.torch`)
    "numba"   float32 on a CPU (`kgs.backends.cpu`, extra "fast")
    "triton"  float32 on GPUs that torch calls "cuda" (NVIDIA, AMD) or "xpu" (`kgs.backends.gpu`; torch brings Triton on
              Linux); on others, as "mps", torch is the only one

A backend is a table of stages, see :class:`Backend`; a new one is a folder, a line in `BACKENDS`, its name in
`kgs.fit.config.Backend`, and its package in `kgs._support` (`extras.py`, `machine.py`). A renderer, a
model or a fit chooses once, by :func:`get_backend`, and hands the table down.
"""

from dataclasses import replace

from torch import device as Device  # `import torch` would be taken for the folder of that name here
from torch.compiler import is_compiling

from kgs._support.errors import ArgumentError, quoted

from .cpu import NUMBA
from .gpu import TRITON
from .table import TORCH, Backend

__all__ = ["BACKENDS", "Backend", "available", "check_backend", "get_backend"]

# "auto" takes the first that is installed, runs on the device and is trusted there
BACKENDS: dict[str, Backend] = {backend.name: backend for backend in (NUMBA, TRITON, TORCH)}


def available() -> tuple[str, ...]:
    """The names that a `backend` argument may have."""
    return ("auto", *sorted(BACKENDS))


def check_backend(name: str | Backend) -> None:
    """Raise a ValueError for a backend that does not exist, a ModuleNotFoundError for one that is not installed."""
    if isinstance(name, Backend) or name == "auto":
        return
    if name not in BACKENDS:
        raise ArgumentError("backend", f"one of {available()}", quoted(name))
    backend = BACKENDS[name]
    if backend.package and not backend.is_installed():
        package, how = backend.package
        raise ModuleNotFoundError(f'backend: "{name}" needs {package}, {how}', name=package)


def get_backend(name: str | Backend, device: Device, *, required: bool = True) -> Backend:
    """The backend of a name on a device; for "auto" the first that is installed, runs there and is trusted.

    Args:
        name: one of :func:`available`; a `Backend` is returned as it is.
        device: where it will run.
        required: whether a backend that is named must be there; if not, "auto" takes its place.

    Raises:
        ValueError: the backend does not exist, or does not run on the device.
        ModuleNotFoundError: it is named and not installed.
    """
    if isinstance(name, Backend):
        return name
    if name == "auto" and is_compiling():  # a graph that is traced has no kernels
        return TORCH
    if required:
        check_backend(name)
    named = BACKENDS.get(name)
    if named is not None and named.is_installed() and named.runs_on(device):
        return replace(named, is_named=True)
    if named is not None and required:
        raise _not_on(device, named)
    return next(x for x in BACKENDS.values() if x.is_installed() and x.runs_on(device) and x.is_trusted(device))


def _not_on(device: Device, named: Backend) -> ArgumentError:
    kernels = [backend.name for backend in BACKENDS.values() if backend.devices and backend.runs_on(device)]
    others = "".join(f'; "{name}" runs on {device}, too' for name in kernels)
    reason = f"which runs on {' and '.join(named.devices or ())} alone{others}"
    return ArgumentError("backend", f'"auto" or "torch" on {device}', f'"{named.name}", {reason}')
