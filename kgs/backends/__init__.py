"""Which implementation of the renderer runs a call: `backend=` by name, and what "auto" takes.

    "torch"   every call (`kgs.backends.torch`)
    "numba"   float32 on a CPU (`kgs.backends.cpu`, extra "fast")
    "triton"  float32 on GPUs that torch calls "cuda" (NVIDIA, AMD) or "xpu" (`kgs.backends.gpu`; torch brings Triton on
              Linux); on others, as "mps", torch is the only one

A backend is a class that names its stages, see :class:`Backend`; a new one is a folder, and a line in `BACKENDS`.
"""

from collections.abc import Callable

from torch import Tensor
from torch import device as Device  # `import torch` would be taken for the folder of that name here

from kgs._support.errors import ArgumentError, quoted

from .base import Backend, OptimizerStages
from .cpu import CpuBackend
from .gpu import GpuBackend
from .torch import TorchBackend

__all__ = [
    "BACKENDS",
    "Backend",
    "available",
    "check_backend",
    "choose",
    "former_or_auto",
    "optimizer_stages",
    "resolve",
    "takes_kernels",
]

# "auto" takes the first that covers a call and is trusted
BACKENDS: tuple[Backend, ...] = (CpuBackend(), GpuBackend(), TorchBackend())


def available() -> tuple[str, ...]:
    """The names that a `backend` argument may have."""
    return ("auto", *sorted(backend.name for backend in BACKENDS))


def check_backend(name: str) -> None:
    """Raise a ValueError for a backend that does not exist, a ModuleNotFoundError for one that is not installed."""
    if name not in available():
        raise ArgumentError("backend", f"one of {available()}", quoted(name))
    for backend in BACKENDS:
        if backend.name == name and backend.package and not backend.is_installed():
            package, how = backend.package
            raise ModuleNotFoundError(f'backend: "{name}" needs {package}, {how}', name=package)


def resolve(name: str, device: Device) -> str:
    """The name of the backend that "auto" takes for float32 on a device; other names are returned unchanged.

    Raises:
        ValueError: the backend does not exist, or it does not run on the device.
        ModuleNotFoundError: it is named and not installed.
    """
    check_backend(name)
    for backend in BACKENDS:
        if backend.runs_on(device) and backend.is_installed() and _may_take(backend, name, device):
            return backend.name
    devices = next(" and ".join(backend.devices or ()) for backend in BACKENDS if backend.name == name)
    others = "".join(f'; "{x.name}" runs on {device}, too' for x in BACKENDS if x.devices and x.runs_on(device))
    reason = f"which runs on {devices} alone{others}"
    raise ArgumentError("backend", f'"auto" or "torch" on {device}', f'"{name}", {reason}')


def former_or_auto(name: str, device: Device) -> str:
    """The name of the backend of an earlier fit where that is installed and runs on the device, else "auto"."""
    former = [backend for backend in BACKENDS if backend.name == name]
    return name if any(backend.runs_on(device) and backend.is_installed() for backend in former) else "auto"


def choose(name: str, stage: str, device: Device, covers: Callable[[Backend], bool]) -> Backend:
    """The backend for a call: for "auto" the first that covers it and is trusted, else the one that is named.

    Args:
        name: what the user asked for.
        stage: what is to be done, for the error.
        device: where.
        covers: whether a backend can do the call.

    Raises:
        ValueError: the backend does not exist, or it is named and does not cover the call.
        ModuleNotFoundError: it is named and not installed.
    """
    for backend in BACKENDS:
        if name in ("auto", backend.name) and covers(backend) and _may_take(backend, name, device):
            return backend
    check_backend(name)
    raise ArgumentError("backend", f'"auto" or "torch" for this call of {stage}', f"{name!r}, which does not cover it")


def optimizer_stages(name: str, like: Tensor) -> OptimizerStages | None:
    """What a backend has for an optimizer of parameters like this one; None where torch does it.

    Raises:
        ValueError: the backend does not exist, or it is named and does not cover such a tensor.
        ModuleNotFoundError: it is named and not installed.
    """
    chosen = choose(name, "optimizer", like.device, lambda backend: backend.covers(like))
    return chosen.optimizer if chosen.has_optimizer else None


def takes_kernels(name: str, stage: str, like: Tensor) -> bool:
    """Whether a stage outside the renderer runs on numba kernels; for stages that exist in numba and torch only.

    These work on a CPU, also where the name is that of a backend of GPUs.

    Raises:
        ValueError: the backend does not exist, or numba is named and does not cover such a tensor.
        ModuleNotFoundError: numba is named and not installed.
    """
    check_backend(name)
    if name == TorchBackend.name:
        return False
    name = name if name == CpuBackend.name else "auto"
    known = (CpuBackend.name, TorchBackend.name)
    chosen = choose(name, stage, like.device, lambda backend: backend.name in known and backend.covers(like))
    return chosen.name == CpuBackend.name


def _may_take(backend: Backend, name: str, device: Device) -> bool:
    """Whether this is the backend that is named, or one that "auto" may take on a device."""
    return name == backend.name or (name == "auto" and backend.is_trusted(device))
