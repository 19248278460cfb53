"""Which implementation runs which stage: the one place where compiled stages stand beside those in torch.

Each stage has one contract. Torch covers every call and defines what is right; another implementation may cover fewer,
gives the same within the rounding of its dtype and differentiates the same. Arguments are checked before.

    "torch"   every call
    "numba"   float32 on a CPU (`kgs.compiled`, extra "fast"); what a stage leaves to torch, its `covers` says

    "projection"   (gaussians, cameras, image size, RasterOptions, with colours) -> ProjectedGaussians
    "compositing"  (projected, features (M, F), RasterOptions, median depth, chunk size) -> Composited
    "loss"         (image (B, C, H, W), target, TargetMoments or None, weight, pixels left out or None, fast) -> loss
    "matching"     (lines (N, 3), places (M, 2), descriptors (N, F), (M, F)) -> distances, rows, columns, each (K,)
    "sweep"        (image (H, W), others (N, H, W), homographies (N, D, 3, 3)) -> smoothed costs, scores, each (D, H, W)

The lists of tiles are no stage: each "compositing" makes its own, laid out for its kernels.
"""

import functools
import importlib.util
import pkgutil
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["available", "check_backend", "choose", "compiled_covers", "register", "resolve"]

STAGES = ("projection", "compositing", "loss", "matching", "sweep")
Pair = tuple[Callable[..., Any] | str, Callable[..., bool]]  # run, covers
_registry: dict[str, dict[str, Pair]] = {stage: {} for stage in STAGES}


def register(
    stage: str, backend: str, run: Callable[..., Any] | str, covers: Callable[..., bool] = lambda *_: True
) -> None:
    """Add an implementation of a stage.

    Args:
        stage: one of `STAGES`.
        backend: its name; what is registered later comes first for "auto".
        run: with the contract of the stage, or where it is found, "package.module:function", loaded at first use.
        covers: with the arguments of `run`, whether it can do this call; cheap, reads no values of tensors.

    Raises:
        ValueError: an unknown stage.
    """
    if stage not in _registry:
        raise ValueError(f"stage: expected one of {STAGES}, got {stage!r}")
    _registry[stage] = {backend: (run, covers)} | _registry[stage]


def available() -> tuple[str, ...]:
    """The names that a `backend` argument may have."""
    return ("auto", *sorted({name for stage in _registry.values() for name in stage}))


def check_backend(backend: str) -> None:
    """Raise a ValueError for a backend that there is not, a ModuleNotFoundError for numba where it is not installed."""
    if backend not in available():
        raise ValueError(f"backend: expected one of {available()}, got {backend!r}")
    if backend == "numba" and not _has_numba():
        raise ModuleNotFoundError('backend: "numba" needs numba, run pip install "kgs-splat[fast]"', name="numba")


def compiled_covers(like: Tensor) -> bool:
    """Whether the kernels can be used for such a tensor: numba is installed, float32, on a CPU, no graph is traced."""
    fits = like.dtype == torch.float32 and like.device.type == "cpu" and not torch.compiler.is_compiling()
    return fits and _has_numba()


def resolve(backend: str, device: torch.device) -> str:
    """The name of what "auto" takes for float32 on a device; another name as it is.

    Raises:
        ValueError: there is no such backend, or it does not run on the device.
        ModuleNotFoundError: numba is named and not installed.
    """
    check_backend(backend)
    if backend == "numba" and device.type != "cpu":
        raise ValueError(f'backend: expected "auto" or "torch" on {device}, got "numba", which runs on a CPU alone')
    compiled = "numba" in available() and device.type == "cpu" and _has_numba()
    return ("numba" if compiled else "torch") if backend == "auto" else backend


@functools.cache
def _has_numba() -> bool:
    return importlib.util.find_spec("numba") is not None


@functools.cache
def _loaded(name: str) -> Callable[..., Any]:
    found: Callable[..., Any] = pkgutil.resolve_name(name)
    return found


def choose(stage: str, backend: str, *arguments: Any) -> Callable[..., Any]:
    """The implementation of a stage for these arguments.

    "auto" takes the latest that covers them. One that is named runs the stages that it has, torch the others.

    Raises:
        ValueError: there is no such backend, or it is named and does not cover the call.
        ModuleNotFoundError: numba is named and not installed.
    """
    check_backend(backend)
    there = _registry[stage]
    names = list(there) if backend == "auto" else [backend if backend in there else "torch"]
    for run, covers in (there[name] for name in names):
        if covers(*arguments):
            return _loaded(run) if isinstance(run, str) else run
    raise ValueError(f'backend: {backend!r} does not cover this call of {stage}, expected "auto" or "torch"')
