"""The training loop: one training view per step, deterministic, resumable at every step.

Views, splits, drop masks and backgrounds have random streams of their own, so that fits with different drop rates see
the same views in the same order.
"""

import copy
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.backends import BACKENDS, resolve
from kgs.camera import move_camera
from kgs.datasets.scene import Scene, Views
from kgs.densify import Densifier
from kgs.drop import DropGaussian
from kgs.errors import DataError, TrainingDiverged
from kgs.geometry import camera_extent, typical_depths
from kgs.init_points import InitialPoints
from kgs.losses import TargetMoments, photometric_loss
from kgs.machine import check_device
from kgs.metrics.evaluate import mean_psnr
from kgs.model import PARAMETERS, GaussianModel
from kgs.renderer import GaussianRenderer
from kgs.types import Gaussians, Rendering, check_kind

from .checkpoint import (
    PLAIN,
    check_plain,
    check_state,
    fingerprint,
    load_moments,
    moments_of,
    newest_checkpoint,
    save_checkpoint,
)
from .config import CHOICES, FitConfig, most_gaussians, timetable, with_pace
from .divergence import bound_scales, gradient_fault, parameter_fault, scale_fault, step_fault
from .poses import MovingPoses, decayed
from .targets import targets

_LOOK = 20  # steps between limits of the scales, and on a GPU between looks for faults: a read waits for all work
# for each parameter the name of its learning rate in the recipe, without `lr_`
_LEARNING_RATES = dict(zip(PARAMETERS, ("means", "quats", "scales", "opacity", "sh_dc", "sh_rest"), strict=True))


@dataclass(frozen=True)
class Start:
    """The state that a fit starts from.

    Args:
        model: the Gaussians.
        init: kind and number of the initial points.
        extent: of the camera rig, in world units; the learning rate of the centres is proportional to it.
        near_plane: of the renderer, in world units.
        depth: the median depth of the initial points, in world units.
    """

    model: GaussianModel
    init: dict[str, Any]
    extent: float
    near_plane: float
    depth: float

    @classmethod
    def from_points(cls, scene: Scene, config: FitConfig, points: InitialPoints) -> Self:
        """Gaussians at the initial points; a TypeError if these are not `InitialPoints`."""
        check_kind("points", points, InitialPoints)
        nearest, median = typical_depths(points.points, scene.train.cameras)
        model = GaussianModel.from_points(points.points.float(), points.colors.float(), config.sh_degree or 0)
        model.sh_degree = 0
        return cls(
            model,
            init={"kind": points.kind, "points": len(points.points)},
            extent=max(camera_extent(scene.train.cameras.extrinsics), 0.01 * median),  # a single camera has extent 0
            near_plane=config.recipe.near_plane * nearest,
            depth=median,
        )

    @classmethod
    def from_state(cls, state: dict[str, Any], config: FitConfig) -> Self:
        """The Gaussians of :meth:`Trainer.state_dict`; a ValueError where the state is not whole."""
        with _state_errors():
            check_plain(state, *PLAIN)
            model = GaussianModel(**copy.deepcopy(state["model"]))
            if model.max_sh_degree != (config.sh_degree or 0) or model.means.dtype != torch.float32:
                raise ValueError(f"model: expected float32 and harmonics of degree {config.sh_degree}, got others")
            depth = 1.0 if state["poses"] is None else float(state["poses"]["depth"])
            return cls(model, copy.deepcopy(state["init"]), state["extent"], state["near_plane"], depth)


class Trainer:
    """Fits Gaussians to the training views of a scene; the test views are rendered only for the curve.

    Args:
        scene: posed training and test views, of at least 6x6 pixels, 12x12 with `coarse`.
        config: the settings; :class:`FitConfig` names those that have no effect here.
        points: the initial points, at least 4; or a `Start`, which `resume` reads from a checkpoint.
        needs: what was decided about the scene before the fit, see `needs` below.

    Raises:
        TypeError: `scene` or `points` is of another type.
        ValueError: images are too small, points too few, or the device or backend is not available.

    Attributes:
        model: the Gaussians.
        renderer: with the drop layer inside; `eval()` mode renders all Gaussians.
        step, seconds: the steps that are done and the time they took, evaluations not counted.
        curve: dicts of step, seconds, test_psnr and train_psnr.
        backend: "numba", "triton" or "torch"; a resumed fit keeps it on devices of the same kind.
        notes: lines that a user should read (a capped count, for instance).
        look_every: steps between looks for what is not finite, 1 on a CPU.
        saved: the last checkpoint that was written or read, in words; "" before the first.
        shown: the Gaussians that :meth:`render` draws: the model, or after :meth:`show` a part of it.
        needs: what was decided about the scene, for metrics.json.
        init, extent, near_plane: kind and number of the initial points; the scales of the scene, in world units.
        order, colors: the random generators of the order of views and of backgrounds.
        stack: views that are still to come before `order` shuffles all again.
        poses: the poses of the training cameras if the fit refines them, else None; `scene` has the current ones.
    """

    def __init__(
        self,
        scene: Scene,
        config: FitConfig,
        points: InitialPoints | Start,
        needs: dict[str, Any] | None = None,
    ) -> None:
        check_kind("scene", scene, Scene)
        self.scene = scene
        self.config = config = with_pace(config, len(scene.train))
        self.device = check_device(config.device)
        self.backend = resolve(config.backend, self.device)
        self.look_every = 1 if self.device.type == "cpu" else _LOOK
        self.times = timetable(config)
        self.step = 0
        self.seconds = 0.0
        self.saved = ""  # where the last checkpoint is
        self.is_saved = False  # whether the last try to write one worked
        self.curve: list[dict[str, float | None]] = []
        self.notes: list[str] = []
        self.needs = dict(needs or {})
        self.stack: list[int] = []
        self._fingerprint = fingerprint(scene)
        self._background = scene.background.to(self.device, torch.float32) if scene.background.any() else None
        self._views = targets(scene.train, scene.background, self.device)
        self._halved = targets(scene.train.halved(), scene.background, self.device) if self.times.coarse else []
        self.poses = MovingPoses(scene.train.cameras.extrinsics, self.times.steps) if config.refine_poses else None
        self._build(points if isinstance(points, Start) else Start.from_points(scene, config, points))

    def _build(self, start: Start) -> None:
        """Make the model, and everything that refers to its parameters."""
        config, recipe, seed = self.config, self.config.recipe, 10 * self.config.seed
        self.init, self.extent, self.near_plane = start.init, start.extent, start.near_plane
        self.max_gaussians = most_gaussians(config, start.init["points"])
        self.model = self.shown = start.model.to(self.device)
        self._part: dict[str, Any] = {}
        groups = [
            {"params": [self.model.get_parameter(name)], "lr": getattr(recipe, f"lr_{rate}"), "name": name}
            for name, rate in _LEARNING_RATES.items()
        ]
        self.optimizer = torch.optim.Adam(groups, eps=recipe.adam_eps, fused=True)
        self.drop: DropGaussian | None = None
        if config.drop:
            self.drop = DropGaussian(config.drop, config.drop_schedule, seed=seed + 1, device=self.device)
        self.renderer = GaussianRenderer(
            self.drop,
            near_plane=self.near_plane,
            max_bytes=config.max_bytes,
            absgrad=recipe.absgrad,
            backend=self.backend,
        ).train()
        self.densifier = Densifier(
            self.model,
            self.optimizer,
            self.extent,
            grad_threshold=recipe.grad_threshold,
            absgrad=recipe.absgrad,
            percent_dense=recipe.percent_dense,
            prune_opacity=recipe.prune_opacity,
            max_gaussians=self.max_gaussians,
            generator=torch.Generator().manual_seed(seed + 2),
        )
        self.order = torch.Generator().manual_seed(seed + 3)
        self.colors = torch.Generator(self.device).manual_seed(seed + 4)
        self._loss = float("nan")
        if self.poses is not None:
            self.poses.depth = start.depth

    def fit(self, callback: "Callable[[Trainer, float], bool] | None" = None) -> None:
        """Train to the end, or until `callback`, called after each step with the trainer and the loss, returns True.

        Raises:
            TrainingDiverged: something is not finite, and that step has changed no parameter; or a scale explodes. On a
                GPU it may be up to 20 steps late, when parameters are damaged; no checkpoint has them.
        """
        while self.step < self.times.steps:
            loss = self.train_step()
            if callback is not None and callback(self, loss):
                return

    def train_step(self) -> float:
        """One step and all that is due after it (curve, densification, reset of the opacities); returns the loss.

        On a GPU the loss is that of the last of every 20 steps: reading a number waits until all work is done.

        Raises:
            TrainingDiverged: see :meth:`fit`.
            ValueError: all steps of the configuration are done.
        """
        if self.step >= self.times.steps:
            raise ValueError(f"steps: expected a step of {self.times.steps} to be left, got none")
        start = time.perf_counter()
        self.shown, self._part = self.model, {}
        loss, step = self._descend(), self.step
        self.seconds += time.perf_counter() - start
        if step in self.times.evaluate:  # before densifying: right after it the image is 2 dB worse for a while
            levels = {"test_psnr": self.psnr(self.scene.test), "train_psnr": self.psnr(self.scene.train)}
            self.curve.append({"step": step, "seconds": round(self.seconds, 3), **levels})
        start = time.perf_counter()
        if step in self.times.densify:
            self._stop_if(scale_fault(self.model, self.extent))
            first, most = self.init["points"], self.max_gaussians
            growing = self.config.growth * self.times.steps  # steps until the limit is reached
            share = min(1.0, step / growing) if growing else 1.0
            self.densifier.max_gaussians = first + round(share * (most - first))
            capped = self.densifier.step().capped
            if capped and share == 1.0 and most < 1.25 * first:
                self.note(f"max_gaussians: {most} leaves little room beside the {first} initial points")
        if step in self.times.reset:
            self.densifier.reset_opacity(self.config.recipe.reset_opacity)
        if step % _LOOK == 0:
            bound_scales(self.model, self.extent)
        self.seconds += time.perf_counter() - start
        return loss

    def note(self, text: str) -> None:
        """Add a line that a user should read to `notes`, once."""
        if text not in self.notes:
            self.notes.append(text)

    def record(self, name: str, found: dict[str, Any]) -> None:
        """Add to `needs` what was found out about the scene, for metrics.json."""
        self.needs[name] = found

    def show(self, rows: Tensor, sh_degree: int) -> None:
        """Render only the Gaussians at `rows`, bool `(N,)`, at this degree until the next step; the fit keeps all."""
        self._part, self.shown = {"rows": rows.cpu(), "sh_degree": sh_degree}, self.model.select(rows, sh_degree)

    def render(self, camera: PinholeCamera) -> Tensor:
        """Render the shown Gaussians from one camera, `(1, 3, H, W)`; the function that `evaluate` takes."""
        self.renderer.eval()
        with torch.no_grad():
            image: Tensor = self.renderer(self.shown(), move_camera(camera, self.device), self._background).image
        self.renderer.train()
        return image

    def median_depth(self, camera: PinholeCamera) -> Tensor:
        """The median depth of the shown Gaussians from one camera, `(H, W)` on the CPU; 0 where there is nothing."""
        self.renderer.eval()
        with torch.no_grad():
            out = self.renderer(self.shown(), move_camera(camera, self.device), outputs=("median_depth",))
        self.renderer.train()
        depth: Tensor = out.median_depth[0, 0].cpu()
        return depth

    def psnr(self, views: Views) -> float | None:
        """Mean PSNR of clamped renders over some views, in dB; None without views, or if one PSNR is infinite."""
        return mean_psnr(self.render, views)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the rest of the fit depends on, copied: nested dicts of tensors and plain values."""
        parts: dict[str, Any] = {"config": self.config.to_dict(), "scene": self._fingerprint, "shown": self._part}
        parts |= {"model": self.model.state_dict(), "densifier": self.densifier.state_dict()}
        parts |= {"optimizer": moments_of(self.optimizer), "order": self.order.get_state()}
        parts |= {"colors": self.colors.get_state(), "drop": None if self.drop is None else self.drop.get_rng_state()}
        parts |= {"poses": None if self.poses is None else self.poses.state_dict()}
        return copy.deepcopy(parts | {name: getattr(self, name) for name in PLAIN})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`, bit for bit. Scene and configuration must be those of the state.

        The device may differ: the backend is that of the state where it runs on the device, and on another kind of
        device random numbers start a new sequence, which `notes` says. If all steps of the state are done, `steps` may
        be larger; `notes` then says what that changes.

        Raises:
            ValueError: scene or configuration differ, or an entry is missing or wrong; the message begins with its
                name. The trainer cannot be used any more.
        """
        with _state_errors():
            start = Start.from_state(state, self.config)
            longer = check_state(state, self._fingerprint, self.config)
            runs = next(x for x in BACKENDS if x.name == state["backend"]).runs_on(self.device)
            self.backend = resolve(state["backend"] if runs else "auto", self.device)
            self._build(start)
            self.step = state["step"]
            self.seconds = state["seconds"]
            self.curve = copy.deepcopy(state["curve"])
            self.notes = [*state["notes"], *longer]
            self.needs = copy.deepcopy(state["needs"])
            self.stack = list(state["stack"])
            load_moments(self.optimizer, copy.deepcopy(state["optimizer"]))
            self.densifier.load_state_dict(state["densifier"])
            self.order.set_state(state["order"])
            if state["shown"]:
                self.show(**state["shown"])
            if self.colors.get_state().shape == state["colors"].shape:
                self.colors.set_state(state["colors"])
                if self.drop is not None:
                    self.drop.set_rng_state(state["drop"])
            else:  # their sizes are those of the kind of device
                self.note(
                    "the checkpoint is of another kind of device: dropping and backgrounds start new random sequences"
                )
            if self.poses is not None:
                self.scene = self.poses.restore(self.scene, state["poses"])

    def save(self, path: str | PathLike[str]) -> None:
        """Write :meth:`state_dict` to a file; after an OSError the checkpoints that were there are untouched.

        Raises:
            TrainingDiverged: on a GPU, a parameter is not finite.
        """
        if self.look_every > 1:
            self._stop_if(parameter_fault(self.model))
        save_checkpoint(Path(path), self.state_dict())
        self.saved, self.is_saved = f"{path} of step {self.step}", True

    @classmethod
    def resume(cls, scene: Scene, config: FitConfig, path: str | PathLike[str]) -> Self:
        """Continue from a checkpoint bit for bit. If it is damaged the one before is used, and `notes` says so.

        Raises:
            DataError: both files are damaged, or they belong to another scene or configuration.
        """
        state, damage = newest_checkpoint(Path(path))
        try:
            decided = {name: state["config"][name] for name in CHOICES if getattr(config, name) is None}
            if config.recipe.opacity_decay is None:  # more steps may have another
                decay = state["config"]["recipe"]["opacity_decay"]
                decided["recipe"] = replace(config.recipe, opacity_decay=decay)
            config = replace(config, **decided)
            trainer = cls(scene, config, Start.from_state(state, config))
            trainer.load_state_dict(state)
        except (KeyError, TypeError) as error:
            raise DataError(path, "config", "expected the configuration of a fit, got another") from error
        except ValueError as error:
            field, _, reason = str(error).partition(": ")
            raise DataError(path, field, reason) from error
        trainer.saved = f"{path} of step {trainer.step}"
        if damage:
            trainer.note(f"{damage}; went on from the previous checkpoint, of step {trainer.step}")
        return trainer

    def _descend(self) -> float:
        config, recipe = self.config, self.config.recipe
        self.step += 1
        progress = self.step / self.times.steps
        rate = decayed(recipe.lr_means, recipe.lr_means_final, progress)
        self.optimizer.param_groups[0]["lr"] = self.extent * rate
        degree = sum(self.step >= step for step in self.times.sh)
        self.model.sh_degree = max(self.model.sh_degree, degree)  # a finished fit that goes on keeps its degree
        index, background = self._next_view(), self._background
        view = (self._halved if self.step <= self.times.coarse else self._views)[index]
        camera = view.camera if self.poses is None else self.poses.camera(view.camera, index)
        target, moments = view.image, view.moments
        if config.training_background == "random":
            background = torch.rand(3, generator=self.colors, dtype=torch.float32, device=self.device)
            target, moments = view.over(background)
        if self.drop is not None:
            self.drop.progress = progress
            self.drop.train(self.step <= self.times.drop)
        out = self.render_view(self.model(), camera, background)
        assert out.image is not None  # a render without `outputs` has it
        loss = self.loss_of(view.seen(out.image), target, moments)
        looks = self.step % self.look_every == 0 or self.step == self.times.steps or math.isnan(self._loss)
        if looks:
            self._loss = float(loss.detach())
            self._stop_if(step_fault(self.model, out.projected.num_nonfinite, self._loss))
        if loss.requires_grad:
            loss.backward()
            if looks:
                self._stop_if(gradient_fault(self.model))
            if out.projected.means2d.grad is not None:
                self.densifier.observe(out.projected)
            if self.step < self.times.steps:  # as in the official release, the last step changes no parameter
                self.optimizer.step()
                decay = recipe.opacity_decay
                if decay is not None and decay < 1.0 and progress > recipe.decay_from:
                    self.densifier.decay_opacity(decay)
                if self.poses is not None:
                    self.scene = self.poses.step(self.scene, progress)
            self.optimizer.zero_grad(set_to_none=True)
        return self._loss

    def render_view(self, gaussians: Gaussians, camera: PinholeCamera, background: Tensor | None) -> Rendering:
        """Render a training view, with the drop layer and gradients."""
        rendering: Rendering = self.renderer(gaussians, camera, background)
        return rendering

    def loss_of(self, image: Tensor, target: Tensor, moments: TargetMoments) -> Tensor:
        """The loss of a training view's render, 0-d; `moments` are the SSIM statistics of the target."""
        weight = self.config.recipe.dssim_weight
        return photometric_loss(image, target, weight, moments=moments, backend=self.backend)

    def _stop_if(self, fault: str) -> None:
        if fault:
            last = f"the last good checkpoint is {self.saved}" if self.saved else "there is no checkpoint yet"
            raise TrainingDiverged(f"step {self.step}: {fault}; {last}")

    def _next_view(self) -> int:
        if not self.stack:
            self.stack = torch.randperm(len(self._views), generator=self.order).tolist()
        return self.stack.pop()


@contextmanager
def _state_errors() -> Iterator[None]:
    """Turn every error about an incomplete state into a ValueError that begins with the entry's name."""
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{error.args[0]}: expected this entry in the state, got none") from error
    except (AttributeError, RuntimeError, TypeError) as error:
        raise ValueError(f"state: {error}") from error
