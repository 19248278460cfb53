"""The state of a training: one value, which is saved and loaded whole."""

import copy
import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from kgs._support.errors import ArgumentError, quoted
from kgs._support.json_files import is_number
from kgs.backends import BACKENDS
from kgs.datasets.scene import Scene, Views
from kgs.densify import Densifier
from kgs.drop import DropGaussian
from kgs.geometry.multiview import typical_depths
from kgs.geometry.rigs import camera_extent
from kgs.init_points import InitialPoints
from kgs.model import PARAMETERS, GaussianModel

from .adam import Adam
from .config import Settings
from .error_points import ErrorPoints
from .exposure import before_gain
from .plan import Plan
from .poses import CameraOptimizer

# for each parameter the name of its learning rate in the recipe, without `lr_`
_LEARNING_RATES = dict(zip(PARAMETERS, ("means", "quats", "scales", "opacity", "sh_dc", "sh_rest"), strict=True))


@dataclass(frozen=True)
class Start:
    """What a training starts from, and what stays the same throughout.

    Args:
        init: kind and number of the initial points.
        extent: of the camera rig, in world units; the learning rate of the centres is proportional to it.
        near_plane: of the renderer, in world units.
        depth: the median depth of the initial points, in world units.
    """

    init: dict[str, Any]
    extent: float
    near_plane: float
    depth: float


@dataclass(eq=False)
class TrainState:
    """Everything that the rest of a fit depends on, besides its scene and its plan.

    Args:
        start: what the training started from.
        model: the Gaussians.
        optimizer: Adam, with a group for each parameter of the model.
        densifier: with the statistics since the last densification, and the random stream of splits.
        drop: the layer on the opacities, with its random stream; None without dropping.
        order: the random stream of the order of views.
        colors: the random stream of backgrounds.
        poses: the poses of the training cameras if the fit refines them, else None.
        error_points: the points that are added where the error is; None without any, and after the last ones.
        step: the steps that are done.
        seconds: the time that they took, evaluations not counted.
        stack: views that are still to come before `order` shuffles all again.
        curve: dicts of step, seconds, test_psnr and train_psnr.
        notes: lines that a user should read (a capped count, for instance).
    """

    start: Start
    model: GaussianModel
    optimizer: Adam
    densifier: Densifier
    drop: DropGaussian | None
    order: torch.Generator
    colors: torch.Generator
    poses: CameraOptimizer | None
    error_points: ErrorPoints | None = None
    step: int = 0
    seconds: float = 0.0
    stack: list[int] = field(default_factory=list)
    curve: list[dict[str, float | None]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @classmethod
    def begin(cls, scene: Scene, plan: Plan, points: InitialPoints) -> Self:
        """The state before the first step, with Gaussians at the initial points."""
        nearest, median = typical_depths(points.points, scene.train.cameras)
        colors = before_gain(points.colors, scene.train.gains, points.views)
        model = GaussianModel.from_points(points.points.float(), colors, plan.config.sh_degree)
        model.sh_degree = 0
        start = Start(
            init={"kind": points.kind, "points": len(points.points)},
            extent=max(camera_extent(scene.train.cameras.extrinsics), 0.01 * median),  # a single camera has extent 0
            near_plane=plan.config.recipe.near_plane * nearest,
            depth=median,
        )
        state = cls._assemble(scene, plan, model, start)
        for note in points.notes:
            state.note(note)
        if points.reserve is not None and plan.schedule.error_points:
            state.error_points = ErrorPoints.of(points.reserve, scene.train, 10 * plan.config.seed + 5, plan.device)
        return state

    @classmethod
    def _assemble(cls, scene: Scene, plan: Plan, model: GaussianModel, start: Start) -> Self:
        """The parts that refer to the model, and fresh random streams."""
        config = plan.config
        recipe = config.recipe
        seed = 10 * config.seed
        model = model.to(plan.device)
        groups = [
            {"params": [model.get_parameter(name)], "lr": getattr(recipe, f"lr_{rate}"), "name": name}
            for name, rate in _LEARNING_RATES.items()
        ]
        optimizer = Adam(groups, eps=recipe.adam_eps, backend=plan.backend)
        drop = None
        if config.drop:
            drop = DropGaussian(config.drop, config.drop_schedule, seed=seed + 1, device=plan.device)
        densifier = Densifier(
            model,
            optimizer,
            start.extent,
            grad_threshold=recipe.grad_threshold,
            absgrad=recipe.absgrad,
            percent_dense=recipe.percent_dense,
            prune_opacity=recipe.prune_opacity,
            max_gaussians=plan.max_gaussians,
            generator=torch.Generator().manual_seed(seed + 2),
            backend=plan.backend,
        )
        poses = None
        if config.refine_poses:
            poses = CameraOptimizer(scene.train.cameras.extrinsics, plan.schedule.steps, start.depth)
        return cls(
            start,
            model,
            optimizer,
            densifier,
            drop,
            order=torch.Generator().manual_seed(seed + 3),
            colors=torch.Generator(plan.device).manual_seed(seed + 4),
            poses=poses,
        )

    def note(self, text: str) -> None:
        """Add a line that a user should read to `notes`, once."""
        if text not in self.notes:
            self.notes.append(text)

    def to_dict(self) -> dict[str, Any]:
        """The state as nested dicts of its own tensors and plain values."""
        parts = {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "densifier": self.densifier.state_dict(),
            "drop": None if self.drop is None else self.drop.get_rng_state(),
            "order": self.order.get_state(),
            "colors": self.colors.get_state(),
            "poses": None if self.poses is None else self.poses.state_dict(),
            "error_points": None if self.error_points is None else self.error_points.state_dict(),
            "init": self.start.init,
            "extent": self.start.extent,
            "near_plane": self.start.near_plane,
            "depth": self.start.depth,
        }
        plain = {name: getattr(self, name) for name in ("step", "seconds", "stack", "curve", "notes")}
        return parts | plain

    @classmethod
    def from_dict(cls, scene: Scene, plan: Plan, values: dict[str, Any]) -> Self:
        """The inverse of :meth:`to_dict`, of values that passed :func:`check_saved`.

        A ValueError, which begins with the entry's name, where another one is wrong.
        On another kind of device random numbers start a new sequence, which `notes` says.
        """
        with state_errors():
            model = GaussianModel(**copy.deepcopy(values["model"]))
            if model.max_sh_degree != plan.config.sh_degree or model.means.dtype != torch.float32:
                given = f"{model.means.dtype} and degree {model.max_sh_degree}"
                raise ArgumentError("model", f"float32 and harmonics of degree {plan.config.sh_degree}", given)
            start = Start(*(copy.deepcopy(values[name]) for name in ("init", "extent", "near_plane", "depth")))
        state = cls._assemble(scene, plan, model, start)
        with state_errors():
            for name in ("step", "seconds", "stack", "curve", "notes"):
                setattr(state, name, copy.deepcopy(values[name]))
            state.optimizer.load_state_dict(copy.deepcopy(values["optimizer"]))
            state.densifier.load_state_dict(values["densifier"])
            state.order.set_state(values["order"])
            if state.colors.get_state().shape == values["colors"].shape:
                state.colors.set_state(values["colors"])
                if state.drop is not None:
                    state.drop.set_rng_state(values["drop"])
            else:  # their sizes are those of the kind of device
                state.note(
                    "the checkpoint is of another kind of device: dropping and backgrounds start new random sequences"
                )
            if state.poses is not None:
                state.poses.load_state_dict(values["poses"])
            if values["error_points"] is not None:
                state.error_points = ErrorPoints(
                    scene.train.cameras, plan.device, **copy.deepcopy(values["error_points"])
                )
        return state


@contextmanager
def state_errors() -> Iterator[None]:
    """Turn every error about an incomplete state into an ArgumentError that names the entry."""
    try:
        yield
    except KeyError as error:
        raise ArgumentError(error.args[0], "this entry in the state", "none") from error
    except torch.OutOfMemoryError:  # says nothing about the state
        raise
    except ArgumentError:
        raise
    except (AttributeError, RuntimeError, TypeError, ValueError) as error:
        raise ArgumentError("state", "that of a fit", advice=str(error)) from error


def fingerprint(scene: Scene) -> dict[str, Any]:
    """SHA-256 sums of photos, masks, poses, intrinsics and background, to notice any change and to name it."""

    def of(views: Views) -> dict[str, Any]:
        tensors = {
            "photos": views.images,
            "alphas": views.alphas,
            "valid pixels": views.valid_mask,
            "poses": views.cameras.extrinsics,
            "intrinsics": views.cameras.intrinsics,
        }
        sums = {what: None if values is None else list(map(digest, values)) for what, values in tensors.items()}
        return {"names": list(views.names), **sums}

    return {"training": of(scene.train), "test": of(scene.test), "background": digest(scene.background)}


def digest(tensor: Tensor) -> str:
    """SHA-256 of the type, shape and numbers of a tensor, in hexadecimal digits."""
    checksum = hashlib.sha256(f"{tensor.dtype} {tuple(tensor.shape)} ".encode())
    checksum.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return checksum.hexdigest()


def check_saved(saved: dict[str, Any], scene: dict[str, Any], config: Settings) -> list[str]:
    """Raise KeyError, TypeError or ValueError unless a saved fit has this fingerprint, configuration and plain values.

    Returns notes for the user, if a finished fit goes on for more steps.
    """
    check_plain(saved, *PLAIN)
    planned = saved["config"]["steps"]
    steps = config.steps
    done = saved["step"]
    notes = list[str]()
    # a fit may continue on another device; its steps are compared below
    asked = config.to_dict() | {name: saved["config"][name] for name in ("device", "steps")}
    if config.backend == "auto":
        asked["backend"] = saved["backend"]
    if planned == done < steps:
        notes.append(
            f"trained on from step {done}, the end of a fit of {planned} steps: from here on learning rates, drop "
            f"rate, densification, resets and looks for haze are those of {steps} steps, so that the result differs "
            f"from a fit of {steps} steps from the start"
        )
    elif planned != steps or done > planned:
        expected = f"{planned}, as the fit was begun with" if done < planned else f"at least the {done} that are done"
        raise ArgumentError("steps", expected, steps)
    _compare_settings(saved["config"] | {"backend": saved["backend"]}, asked)
    for part in ("training", "test"):
        for what, sums in scene[part].items():
            before = saved["scene"][part][what]
            if before != sums:
                both = zip(scene[part]["names"], before or [], sums or [], strict=False)
                changed = ", ".join(name for name, one, other in both if one != other)
                given = (
                    f"changed ones: {changed:.200}" if changed else f"{len(sums or [])} instead of {len(before or [])}"
                )
                raise ArgumentError(f"{what} of the {part} views", "those that the fit was begun with", given)
    if saved["scene"]["background"] != scene["background"]:
        raise ArgumentError("background", "the colour that the fit was begun with", "another one")
    if max(saved["stack"], default=0) >= len(scene["training"]["names"]):
        raise ArgumentError("stack", "views of the scene", saved["stack"])
    return notes


def _compare_settings(saved: dict[str, Any], asked: dict[str, Any], path: str = "") -> None:
    for name, value in asked.items():
        if name not in saved:
            raise ArgumentError(f"{path}{name}", "a fit of this version of kgs", "one without this setting")
        before = saved[name]
        if isinstance(value, dict) and isinstance(before, dict):
            _compare_settings(before, value, f"{path}{name}.")
        elif before != value:
            raise ArgumentError(f"{path}{name}", f"{before!r}, as the fit was begun with", quoted(value))


def check_plain(values: dict[str, Any], *names: str) -> None:
    """Raise KeyError or ValueError if one of these plain values of a saved fit is missing or wrong."""
    for name in names:
        expected, is_right = PLAIN[name]
        if not is_right(values[name]):
            raise ArgumentError(name, expected, quoted(values[name]))


_is_count = partial(is_number, minimum=0, whole=True)


def _is_list(value: Any, is_right: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(map(is_right, value))


def _is_point(value: Any) -> bool:
    keys = {"step", "seconds", "test_psnr", "train_psnr"}
    return value.keys() == keys and all(x is None or is_number(x) for x in value.values())


# The plain values of a saved fit: what is expected of each in words, and the check.
PLAIN: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "backend": (f"one of {list(BACKENDS)}", lambda v: v in BACKENDS),
    "init": ("kind and number of initial points", lambda v: v.keys() == {"kind", "points"} and _is_count(v["points"])),
    "step": ("a number of steps", _is_count),
    "seconds": ("a number, not negative", lambda v: is_number(v, 0)),
    "curve": ("a list of measurements", lambda v: _is_list(v, _is_point)),
    "notes": ("a list of texts", lambda v: _is_list(v, lambda x: isinstance(x, str))),
    "decisions": ("what was decided", lambda v: isinstance(v, dict)),
    "extent": ("a number above 0", lambda v: is_number(v, 1e-300)),
    "near_plane": ("a number above 0", lambda v: is_number(v, 1e-300)),
    "depth": ("a number above 0", lambda v: is_number(v, 1e-300)),
    "stack": ("a list of views", lambda v: _is_list(v, _is_count)),
}
