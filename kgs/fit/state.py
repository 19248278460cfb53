"""What a checkpoint must hold for a fit to go on from it: its own fit's scene and configuration, and sound values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch import Tensor, nn
from torch.optim import Optimizer

from kgs.datasets.scene import Scene
from kgs.errors import DataError

from .config import FitConfig

if TYPE_CHECKING:
    from .trainer import Trainer

__all__ = ["check_state", "restore", "trainer_state"]

_POINT = {"step", "seconds", "test_psnr", "train_psnr"}


def trainer_state(trainer: Trainer) -> dict[str, Any]:
    """Everything that the rest of a fit depends on."""
    return {
        "config": trainer.config.to_dict(),
        "scene": _fingerprint(trainer.scene),
        "init": trainer.init,
        "step": trainer.step,
        "seconds": trainer.seconds,
        "curve": trainer.curve,
        "notes": trainer.notes,
        "extent": trainer.extent,
        "max_gaussians": trainer.max_gaussians,
        "near_plane": trainer.renderer.near_plane,
        "model": trainer.model.state_dict(),
        "sh_degree": trainer.model.sh_degree,
        "optimizer": trainer.optimizer.state_dict(),
        "densifier": trainer.densifier.state_dict(),
        "order": trainer.order.get_state(),
        "stack": trainer.stack,
        "drop": None if trainer.drop is None else trainer.drop.get_rng_state(),
    }


def restore(trainer: Trainer, state: dict[str, Any]) -> None:
    """Bring a trainer whose model is there to where a checkpoint left it: optimiser, densifier, random streams, counts.

    Raises:
        AttributeError, KeyError, RuntimeError, TypeError or ValueError: an entry is missing or does not fit.
    """
    groups = trainer.optimizer.state_dict()["param_groups"]  # they follow from the configuration
    trainer.optimizer.load_state_dict({"state": state["optimizer"]["state"], "param_groups": groups})
    _check_optimizer(trainer.optimizer)
    trainer.densifier.load_state_dict(state["densifier"])
    trainer.order.set_state(state["order"])
    if trainer.drop is not None:
        trainer.drop.set_rng_state(state["drop"])
    trainer.step, trainer.seconds = state["step"], state["seconds"]
    trainer.curve, trainer.notes, trainer.stack = state["curve"], state["notes"], state["stack"]


def _fingerprint(scene: Scene) -> dict[str, Any]:
    """A few plain values that tell a scene's training views from others."""
    views = scene.train
    return {
        "names": list(views.names),
        "size": list(views.images.shape[-2:]),
        "images": float(views.images.double().mean()),
        "cameras": float(views.cameras.extrinsics.double().sum() + views.cameras.intrinsics.double().sum()),
    }


def check_state(path: Path, state: dict[str, Any], scene: Scene, config: FitConfig) -> None:
    """Make sure that a checkpoint belongs to this fit and that its plain values can be used.

    Raises:
        DataError: an entry is missing or wrong, or the scene or the configuration is another.
    """
    for field, asked in (("config", config.to_dict()), ("scene", _fingerprint(scene))):
        saved = state.get(field)
        for key, value in asked.items():
            if key == "device":  # a fit may go on elsewhere
                continue
            if not isinstance(saved, dict) or key not in saved or saved[key] != value:
                got = saved.get(key) if isinstance(saved, dict) else saved
                raise DataError(path, f"{field}.{key}", f"expected {value!r} as asked for now, got {str(got)[:200]!r}")
    views = len(scene.train)
    for field, what, is_right in (
        ("init", "a kind and a number of points", _is_init),
        ("step", f"a number from 0 to {config.steps}", lambda v: _is_int(v, 0, config.steps)),
        ("seconds", "a number, not negative", lambda v: _is_number(v) and v >= 0),
        ("curve", "a list of measurements", lambda v: isinstance(v, list) and all(map(_is_point, v))),
        ("notes", "a list of texts", lambda v: isinstance(v, list) and all(isinstance(x, str) for x in v)),
        ("extent", "a number above 0", lambda v: _is_number(v) and v > 0),
        ("max_gaussians", "a number of at least 1", lambda v: _is_int(v, 1, 2**48)),
        ("near_plane", "a number above 0", lambda v: _is_number(v) and v > 0),
        ("model", "tensors", lambda v: isinstance(v, dict) and all(isinstance(x, Tensor) for x in v.values())),
        ("sh_degree", f"a number from 0 to {config.sh_degree}", lambda v: _is_int(v, 0, config.sh_degree)),
        ("stack", "views", lambda v: isinstance(v, list) and all(_is_int(x, 0, views - 1) for x in v)),
    ):
        if field not in state or not is_right(state[field]):
            got = f"{str(state[field])[:80]!r}" if field in state else "none"
            raise DataError(path, field, f"expected {what}, got {got}")


def _check_optimizer(optimizer: Optimizer) -> None:
    """Make sure that Adam's state is that of the parameters and has their shapes, which torch does not.

    Raises:
        ValueError: it is not.
    """
    parameters = {parameter for group in optimizer.param_groups for parameter in group["params"]}
    if not optimizer.state.keys() <= parameters:
        raise ValueError("expected the optimiser's state of the parameters alone, got more")
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            state = optimizer.state.get(parameter)
            if state and not _is_adam(state, parameter):
                raise ValueError(
                    f"expected a step and two moments of shape {tuple(parameter.shape)} for {group['name']}"
                )


def _is_adam(state: dict[str, Any], parameter: nn.Parameter) -> bool:
    shapes = {"step": (), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
    return state.keys() == shapes.keys() and all(
        isinstance(state[name], Tensor)
        and state[name].shape == shape
        and bool((state[name] >= 0).all() or name == "exp_avg")
        for name, shape in shapes.items()
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


def _is_int(value: Any, least: int, most: int) -> bool:
    return type(value) is int and least <= value <= most


def _is_dict(value: Any, keys: set[str]) -> bool:
    return isinstance(value, dict) and value.keys() == keys


def _is_init(value: Any) -> bool:
    return _is_dict(value, {"kind", "points"}) and isinstance(value["kind"], str) and _is_int(value["points"], 1, 2**48)


def _is_point(value: Any) -> bool:
    return _is_dict(value, _POINT) and all(x is None or _is_number(x) for x in value.values())
