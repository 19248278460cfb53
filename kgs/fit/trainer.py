"""The training loop: one training view per step, deterministic, resumable at every step.

Views, splits, drop masks and backgrounds have random streams of their own, so that fits with different drop rates see
the same views in the same order.
"""

import copy
import math
import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.checks import check_kind
from kgs._support.default_device import cpu_by_default
from kgs._support.errors import ArgumentError, TrainingDiverged
from kgs.backends import BACKENDS, get_backend
from kgs.datasets.scene import Scene
from kgs.geometry.types import Gaussians, RasterOptions, Rendering
from kgs.init_points import InitialPoints
from kgs.losses import photometric_loss
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .checkpoint import errors_of, newest_checkpoint, previous, save_checkpoint
from .config import FitConfig, Settings
from .decisions import Decisions
from .divergence import bound_scales, gradient_fault, parameter_fault, scale_fault, step_fault
from .error_points import ErrorPoints
from .exposure import with_exposure
from .fit import Fit
from .haze import FADE, veils
from .plan import Plan
from .poses import decayed, with_extrinsics
from .state import TrainState, check_plain, check_saved, fingerprint, state_errors
from .targets import Target, background_of, targets

_LOOK = 20  # steps between limits of the scales, and on a GPU between looks for faults: a read waits for all work


class Trainer:
    """Fits Gaussians to the training views of a scene. The test views are rendered for the curve alone.

    Args:
        scene: posed training and test views, of at least 6x6 pixels, 12x12 with `coarse`.
        plan: the settings, see :func:`make_plan`; :class:`FitConfig` names those that have no effect here.
        points: the initial points, at least 4; or a :meth:`state_dict` to continue from.

    Raises:
        TypeError: an argument is of another type.
        ValueError: images are too small, points too few, or the state is of another fit.

    Attributes:
        plan: as given.
        state: everything that changes, a `kgs.fit.state.TrainState`.
        renderer: with the drop layer inside; in `eval()` mode it renders all Gaussians.
        saved: the last checkpoint that was written or read, in words; "" before the first.
        is_saved: whether the last try to write one worked.
    """

    @cpu_by_default
    def __init__(self, scene: Scene, plan: Plan, points: InitialPoints | dict[str, Any]) -> None:
        check_kind("scene", scene, Scene)
        check_kind("plan", plan, Plan)
        self._input_scene = scene
        self.plan = plan
        self.saved = ""
        self.is_saved = False
        device = plan.device
        self._look_every = 1 if device.type == "cpu" else _LOOK
        self._loss = float("nan")
        self._background = background_of(scene, device)
        self._fingerprint = fingerprint(scene)
        if isinstance(points, dict):
            self.load_state_dict(points)
        else:
            check_kind("points", points, InitialPoints)
            exposed = with_exposure(scene, plan.decisions)
            self._use(TrainState.begin(exposed, plan, points), exposed)

    def _use(self, state: TrainState, scene: Scene) -> None:
        """Train on from a state, on a scene with the gains that were decided."""
        config = self.plan.config
        self.state = state
        self._backend = replace(
            get_backend(self.plan.backend, self.plan.device),
            is_named=config.backend != "auto",  # else torch may take its place
        )
        self.renderer = GaussianRenderer(
            state.drop,
            near_plane=state.start.near_plane,
            max_bytes=config.max_bytes,
            absgrad=config.recipe.absgrad,
            backend=self._backend,
        ).train()
        self._exposed_scene = scene
        self._views = targets(scene.train, scene.background, self.plan.device)
        self._half_size = (
            targets(scene.train.downsample(2), scene.background, self.plan.device) if self.plan.schedule.coarse else []
        )

    @property
    def scene(self) -> Scene:
        """The scene, with the current poses of the training cameras where the fit refines them."""
        poses = self.state.poses
        return self._exposed_scene if poses is None else with_extrinsics(self._exposed_scene, poses.extrinsics)

    @property
    def model(self) -> GaussianModel:
        """The Gaussians."""
        return self.state.model

    @property
    def step(self) -> int:
        """The number of steps that are done."""
        return self.state.step

    def fit(self, callback: "Callable[[Trainer, float], bool] | None" = None) -> Fit:
        """Train to the end, or until `callback`, called after each step with the trainer and the loss, returns True.

        Raises:
            TrainingDiverged: something is not finite, and that step has changed no parameter; or a scale explodes. On a
                GPU it may be up to 20 steps late, when parameters are damaged; no checkpoint has them.
        """
        while self.step < self.plan.schedule.steps:
            loss = self.train_step()
            if callback is not None and callback(self, loss):
                break
        return self.result()

    def result(self) -> Fit:
        """The fit as far as it is, with the model that is trained."""
        state = self.state
        return Fit(
            scene=self.scene,
            model=state.model,
            options=replace(self.renderer.options, alpha_threshold=RasterOptions.alpha_threshold, absgrad=False),
            backend=self.plan.backend,
            settings=self.plan.config,
            history={
                "steps": state.step,
                "seconds": round(state.seconds, 2),
                "curve": state.curve,
                "init": state.start.init,
                "poses": None if state.poses is None else state.poses.moved(),
            },
            decisions=self.plan.decisions,
            notes=tuple(state.notes),
        )

    @cpu_by_default
    def train_step(self) -> float:
        """The loss of one step, which is done with all that is due after it: curve, densification, reset of opacities.

        On a GPU the loss is that of the last of every 20 steps: reading a number waits until all work is done.

        Raises:
            TrainingDiverged: see :meth:`fit`.
            ValueError: all steps of the plan are done.
            RuntimeError: within `torch.inference_mode`, where there are no gradients.
        """
        if torch.is_inference_mode_enabled():
            raise RuntimeError("train_step: expected no torch.inference_mode, in which there are no gradients")
        state = self.state
        schedule = self.plan.schedule
        if state.step >= schedule.steps:
            raise ArgumentError("steps", f"a step of {schedule.steps} to be left", "none")
        start = time.perf_counter()
        with self._backend.beside(), torch.enable_grad():
            loss = self._optimize()
        state.seconds += time.perf_counter() - start
        if state.step in schedule.evaluate:  # before densifying: right after it the image is 2 dB worse for a while
            self._measure_curve()
        start = time.perf_counter()
        if state.step in schedule.haze:
            with self._backend.beside():
                state.densifier.decay_opacity(FADE, veils(self.result()))
        if state.step in schedule.densify:
            with self._backend.beside():
                self._densify()
        if state.step in schedule.error_points and state.error_points is not None:
            self._add_where_the_error_is(state.error_points)
        if state.step in schedule.reset:
            state.densifier.reset_opacity(self.plan.config.recipe.reset_opacity)
        if state.step % _LOOK == 0:
            bound_scales(state.model, state.start.extent)
        state.seconds += time.perf_counter() - start
        return loss

    def render_view(self, gaussians: Gaussians, camera: PinholeCamera, background: Tensor | None) -> Rendering:
        """The render of a training step."""
        rendering: Rendering = self.renderer(gaussians, camera, background)
        return rendering

    def loss_of(self, image: Tensor, view: Target) -> Tensor:
        """The loss of a training step, 0-d: of an image `(1, 3, H, W)` beside its photo."""
        recipe = self.plan.config.recipe
        return photometric_loss(image, view.image, recipe.dssim_weight, moments=view.moments, backend=self._backend)

    def state_dict(self) -> dict[str, Any]:
        """The state, and what it belongs to: nested dicts of tensors and plain values, copied."""
        return copy.deepcopy(self._state_dict())

    def _state_dict(self) -> dict[str, Any]:
        return self.state.to_dict() | {
            "config": self.plan.config.to_dict(),
            "backend": self.plan.backend,
            "decisions": self.plan.decisions.to_dict(),
            "scene": self._fingerprint,
        }

    def load_state_dict(self, values: dict[str, Any]) -> None:
        """Continue from a :meth:`state_dict`, bit for bit. Scene and configuration must be those of the state.

        The device may differ: the backend is that of the state where it runs on the device, and on another kind of
        device random numbers start a new sequence, which the notes say. If all steps of the state are done, `steps` may
        be larger; the notes then say what that changes.

        Raises:
            ValueError: scene or configuration differ, or an entry is missing or wrong; the message begins with its
                name. The trainer is unchanged.
        """
        plan = self.plan
        with state_errors():
            longer = check_saved(values, self._fingerprint, plan.config)
            runs = BACKENDS[values["backend"]].runs_on(plan.device)
            backend = get_backend(values["backend"] if runs else "auto", plan.device).name
            decisions = Decisions.from_dict(values["decisions"])
            exposed = with_exposure(self._input_scene, decisions)
            plan = replace(Plan.of(plan.config, values["init"]["points"], decisions), backend=backend)
        state = TrainState.from_dict(self._input_scene, plan, values)
        self.plan = plan
        state.notes += longer
        self._use(state, exposed)

    def save(self, path: str | PathLike[str], part: dict[str, Any] | None = None) -> None:
        """Write a checkpoint. After an OSError one that was there is still there.

        Args:
            path: the file to write.
            part: which of the Gaussians a fit that is done shows, see :attr:`Fit.part`.

        Raises:
            TrainingDiverged: on a GPU, a parameter is not finite.
        """
        if self._look_every > 1:
            self._stop_if(parameter_fault(self.model))
        self.is_saved = False
        save_checkpoint(Path(path), self._state_dict() | {"shown": part or {}})
        self.saved = f"{path} of step {self.step}"
        self.is_saved = True

    @classmethod
    def resume(cls, scene: Scene, config: FitConfig, path: str | PathLike[str]) -> Self:
        """Continue from a checkpoint bit for bit. If it is damaged the one before takes its place, as the notes say.

        What the configuration leaves open is as it was decided for the checkpoint.

        Raises:
            TypeError: an argument is of another type.
            DataError: both files are damaged, or they belong to another scene or configuration.
            ValueError: the device cannot be used, or the backend does not run on it.
            ModuleNotFoundError: the backend is numba or triton, and it is not installed.
        """
        check_kind("scene", scene, Scene)
        check_kind("config", config, FitConfig)
        values, damage = newest_checkpoint(Path(path))
        with errors_of(path), state_errors():
            check_plain(values, "init")
            settings = Settings.from_dict(values["config"]).of_resumed(config)
        plan = Plan.of(settings, values["init"]["points"], Decisions())
        with errors_of(path):
            trainer = cls(scene, plan, values)
        trainer.saved = f"{path} of step {trainer.step}"
        if damage:
            with suppress(OSError):  # else the next checkpoint would put the damaged one in place of the whole one
                os.replace(previous(Path(path)), path)
            trainer.state.note(f"{damage}; went on from the previous checkpoint, of step {trainer.step}")
        return trainer

    def _optimize(self) -> float:
        """The loss of a training view, by whose gradients the parameters are moved."""
        state = self.state
        config = self.plan.config
        steps = self.plan.schedule.steps
        state.step += 1
        progress = state.step / steps
        self._set_progress(progress)
        index = self._next_view()
        view = (self._half_size if state.step <= self.plan.schedule.coarse else self._views)[index]
        camera = view.camera if state.poses is None else state.poses.camera(view.camera, index)
        background = self._background
        if config.training_background == "random":
            background = torch.rand(3, generator=state.colors, dtype=torch.float32, device=self.plan.device)
            view = view.over_background(background, self._backend)
        gaussians = state.model(backend=self._backend)
        rendering: Any = self.render_view(gaussians, camera, view.background_before_gain(background))
        if rendering.projected.means2d.requires_grad:
            rendering.projected.means2d.retain_grad()  # for the densifier
        image = view.as_photographed(rendering.image)
        loss = self.loss_of(image, view)
        looks = state.step % self._look_every == 0 or state.step == steps or math.isnan(self._loss)
        if looks:
            self._loss = float(loss.detach())
            self._stop_if(step_fault(state.model, rendering.projected.num_nonfinite, self._loss))
        if state.error_points is not None:
            state.error_points.observe(index, image.detach(), view.image)
        if loss.requires_grad:
            loss.backward()
            if looks:
                self._stop_if(gradient_fault(state.model))
            if rendering.projected.means2d.grad is not None:
                state.densifier.observe(rendering.projected)
            if state.step < steps:  # as in the official release, the last step changes no parameter
                self._move(progress)
            state.optimizer.zero_grad()
        return self._loss

    def _set_progress(self, progress: float) -> None:
        """Set what depends on the share of the steps that are done: learning rate, degree, drop rate, footprints."""
        state = self.state
        recipe = self.plan.config.recipe
        threshold = recipe.alpha_threshold
        if progress > recipe.threshold_until:
            threshold = min(threshold, RasterOptions.alpha_threshold)
        if threshold != self.renderer.options.alpha_threshold:
            self.renderer.options = replace(self.renderer.options, alpha_threshold=threshold)
        rate = decayed(recipe.lr_means, recipe.lr_means_final, progress)
        for group in state.optimizer.param_groups:
            if group["name"] == "means":
                group["lr"] = state.start.extent * rate
        degree = sum(state.step >= step for step in self.plan.schedule.sh)
        if degree > state.model.sh_degree:  # a finished fit that goes on keeps its degree
            state.model.sh_degree = degree
        if state.drop is not None:
            state.drop.progress = progress
            drops = state.step <= self.plan.schedule.drop
            if drops != state.drop.training:
                state.drop.train(drops)

    def _move(self, progress: float) -> None:
        """Change the parameters by their gradients."""
        state = self.state
        recipe = self.plan.config.recipe
        state.optimizer.step()
        if recipe.opacity_decay < 1.0 and progress > recipe.decay_from:
            state.densifier.decay_opacity(recipe.opacity_decay)
        if state.poses is not None:
            state.poses.step(progress)

    def _measure_curve(self) -> None:
        state = self.state
        fit = self.result()
        levels = {"test_psnr": fit.psnr(fit.scene.test), "train_psnr": fit.psnr(fit.scene.train)}
        state.curve.append({"step": state.step, "seconds": round(state.seconds, 3), **levels})

    def _densify(self) -> None:
        state = self.state
        self._stop_if(scale_fault(state.model, state.start.extent))
        first = state.start.init["points"]
        maximum = self.plan.max_gaussians
        capped = state.densifier.step().capped
        if capped and maximum < 1.25 * first and maximum != self.plan.config.init_points:
            state.note(f"max_gaussians: {maximum} leaves little room beside the {first} initial points")

    def _add_where_the_error_is(self, points: ErrorPoints) -> None:
        state = self.state
        count = len(state.model)
        wanted = min(round(self.plan.config.recipe.error_points * count), self.plan.max_gaussians - count)
        state.densifier.add(points.draw(wanted, state.model.max_sh_degree))
        if state.step == self.plan.schedule.error_points[-1]:
            state.error_points = None  # checkpoints are smaller without it

    def _stop_if(self, fault: str) -> None:
        if fault:
            last = f"the last good checkpoint is {self.saved}" if self.saved else "there is no checkpoint yet"
            raise TrainingDiverged(f"step {self.step}: {fault}; {last}")

    def _next_view(self) -> int:
        state = self.state
        if not state.stack:
            state.stack = torch.randperm(len(self._views), generator=state.order).tolist()
        return state.stack.pop()
