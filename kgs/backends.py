"""Which implementation runs which stage: the one place where compiled stages stand beside those in torch.

Each stage has one contract. Torch covers every call and defines what is right; another implementation may cover fewer,
gives the same within the rounding of its dtype and differentiates the same. Arguments are checked before.

    "projection"   (gaussians, cameras, image size, RasterOptions, with colours) -> ProjectedGaussians
    "compositing"  (projected, features (M, F), RasterOptions, median depth, chunk size) -> Composited
    "loss"         (image (1, K, H, W), its TargetMoments one by one, windows left out or None) -> mean SSIM, 0-d

The lists of tiles are no stage: each "compositing" makes its own, laid out for its kernels.
"""

from collections.abc import Callable
from typing import Any

__all__ = ["available", "check_backend", "choose", "register"]

STAGES = ("projection", "compositing", "loss")
Pair = tuple[Callable[..., Any], Callable[..., bool]]  # run, covers
_registry: dict[str, dict[str, Pair]] = {stage: {} for stage in STAGES}


def register(stage: str, backend: str, run: Callable[..., Any], covers: Callable[..., bool] = lambda *_: True) -> None:
    """Add an implementation of a stage.

    Args:
        stage: one of `STAGES`.
        backend: its name; what is registered later comes first for "auto".
        run: with the contract of the stage.
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
    """Raise a ValueError that names what there is, for a backend that there is not."""
    if backend not in available():
        raise ValueError(f"backend: expected one of {available()}, got {backend!r}")


def choose(stage: str, backend: str, *arguments: Any) -> Callable[..., Any]:
    """The implementation of a stage for these arguments.

    "auto" takes the latest that covers them. One that is named runs the stages that it has, torch the others.

    Raises:
        ValueError: there is no such backend, or it is named and does not cover the call.
    """
    check_backend(backend)
    there = _registry[stage]
    names = list(there) if backend == "auto" else [backend if backend in there else "torch"]
    for run, covers in (there[name] for name in names):
        if covers(*arguments):
            return run
    raise ValueError(f'backend: {backend!r} does not cover this call of {stage}, expected "auto" or "torch"')
