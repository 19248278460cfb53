"""Small fits in processes of their own, that tests kill, stop and rob of their disk."""

from __future__ import annotations

import multiprocessing
import os
import resource
import time
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np

from kgs.fit.config import FitConfig, Recipe, Settings
from kgs.fit.plan import make_schedule

__all__ = ["PATIENCE", "Fit", "memory_of", "start_command"]

SIZE = (48, 64)
PATIENCE = 300.0  # seconds after which a process is taken to hang
_PROCESSES = multiprocessing.get_context("forkserver")  # which has imported what they need once for all of them
_PROCESSES.set_forkserver_preload(["kgs.datasets", "kgs.app.fit_folder", "torch._dynamo", "trimesh", "tyro"])


def _config(steps: int, points: Path, **changes: Any) -> FitConfig:
    """Densification, resets, harmonics and dropping all happen; a checkpoint is written every third step."""
    recipe = Recipe(grad_threshold=1e-5, prune_opacity=0.005, reset_interval=3000, reset_recovery=5)
    config = FitConfig(steps=steps, drop=0.3, evaluations=steps // 3, max_gaussians=1500, sh_degree=3, recipe=recipe)
    schedule = make_schedule(Settings.of(config, coarse=0.0, opacity_decay=1.0))
    if not (schedule.densify and schedule.reset and len(schedule.sh) == 3):
        raise RuntimeError(f"steps: expected room for all that a fit can do, got {steps}: {schedule}")
    return replace(config, init="file", init_file=points, **changes)


def _write_points(path: Path) -> None:
    """Few initial points before the cameras, so that there is much to add."""
    import trimesh

    points = np.random.default_rng(0).uniform((-2, -1.5, 3), (2, 1.5, 7), (300, 3))
    trimesh.PointCloud(points, np.full((300, 4), 128, np.uint8)).export(path)


class Fit:
    """A fit in a folder, that can be started, watched and brought to its end."""

    def __init__(self, folder: Path, name: str, steps: int) -> None:
        self.out, self.steps = folder / name, steps
        self.started, self.points = folder / f"{name}.started", folder / "points.ply"
        if not self.points.exists():
            _write_points(self.points)

    def start(self, limit: int | None = None) -> BaseProcess:
        """Begin, or go on; with a limit, no file may grow beyond so many bytes after a fifth of the steps."""
        self.started.unlink(missing_ok=True)
        process = _PROCESSES.Process(target=_fit, args=(self, limit))
        process.start()
        return process

    def finish(self) -> bytes:
        """Run it to its end, from where it is; what splat.ply holds."""
        process = self.start()
        process.join(PATIENCE)
        if process.exitcode != 0:
            process.kill()
            raise RuntimeError(f"{self.out}: expected the fit to end with 0, got {process.exitcode}")
        return (self.out / "splat.ply").read_bytes()

    def wait_for_steps(self, process: BaseProcess) -> bool:
        """Whether the fit got to a step before it ended."""
        end = time.monotonic() + PATIENCE
        while process.is_alive() and not self.started.exists() and time.monotonic() < end:
            time.sleep(0.005)
        return process.is_alive()


def _fit(fit: Fit, limit: int | None) -> None:
    import torch
    from fits_in_folders import fit_in

    from kgs.app.scene_request import SceneRequest
    from kgs.datasets import synthetic_scene
    from kgs.fit.trainer import Trainer

    torch.set_num_threads(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the progress lines
    scene = synthetic_scene(train_views=3, test_views=1, size=SIZE, seed=0)
    measure = Trainer._measure_curve

    def measure_curve(trainer: Trainer) -> None:  # but for the last time, measuring the curve is not what is tested
        fit.started.touch()
        if limit is not None and trainer.step >= fit.steps // 5:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        if trainer.step == trainer.plan.schedule.steps:
            measure(trainer)

    Trainer._measure_curve = measure_curve  # type: ignore[method-assign]
    try:
        config = _config(fit.steps, fit.points)
        published = fit_in(scene, config, fit.out, SceneRequest("."), resume=True, say=lambda _: None)
    except OSError:
        os._exit(1)  # as the command does, with one line
    if published.signal:
        os._exit(128 + published.signal)


def start_command(*words: object) -> BaseProcess:
    """Start `kgs` with these words in a process of its own."""
    process = _PROCESSES.Process(target=_command, args=tuple(map(str, words)))
    process.start()
    return process


def _command(*words: str) -> None:
    import torch

    from kgs.app.cli.run import exit_code

    torch.set_num_threads(1)
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    os._exit(exit_code(list(words)))


def memory_of(folder: Path, steps: int) -> tuple[float, int, int]:
    """A fit under a memory budget, in a process of its own.

    Returns:
        Growth in KiB per step over the second half, whose number of Gaussians stays; the peak of the resident memory
        over that at the start, and a bound for it, in bytes.
    """
    Fit(folder, "memory", steps)
    with _PROCESSES.Pool(1) as pool:
        return pool.apply(_memory_of, (folder / "points.ply", steps))


def _memory_of(points: Path, steps: int) -> tuple[float, int, int]:
    import torch

    from kgs.datasets import synthetic_scene
    from kgs.fit.plan import make_plan
    from kgs.fit.run import choose_points
    from kgs.fit.trainer import Trainer

    torch.set_num_threads(1)
    scene = synthetic_scene(train_views=3, test_views=1, size=SIZE, seed=0)
    config = replace(_config(steps, points, max_bytes=2**22), evaluations=1)
    points = choose_points(scene, config)
    Trainer(scene, make_plan(scene, config, points), points).train_step()  # libraries and kernels are loaded
    trainer = Trainer(scene, make_plan(scene, config, points), points)
    before, resident = _resident(), []

    def note(trainer: Trainer, _: float) -> bool:
        resident.append(_resident())
        return False

    trainer.fit(note)
    half = resident[len(resident) // 2 :]
    middle = len(half) // 2
    slope = (sum(half[middle:]) / len(half[middle:]) - sum(half[:middle]) / middle) / middle
    photos = scene.train.images
    images = 40 * photos[:1].nbytes + 4 * photos.nbytes  # those of the loss, and copies
    # and parameters, gradients, moments and copies of each Gaussian
    ceiling = config.max_bytes + 4096 * trainer.plan.max_gaussians + images
    return slope / 1024, max(resident) - before, ceiling


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
