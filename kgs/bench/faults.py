"""What a long fit survives: kill -9 at random moments, SIGTERM, a full disk, and its memory over many steps.

Fits run in processes of their own. A fit that was killed and resumed, however often, must end in the very bits of one
that was left alone.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import resource
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from kgs.errors import DataError
from kgs.fit.config import FitConfig, Recipe
from kgs.fit.outputs import versions, write_json

from .output import markdown_table, write_csv

__all__ = ["measure_faults"]

SIZE = (48, 64)
# Densification, resets, harmonics and dropping all happen; a checkpoint is written every third step.
CONFIG = FitConfig(
    steps=450, evaluations=150, max_gaussians=1500, recipe=Recipe(grad_threshold=1e-5, reset_recovery=30)
)
POINTS = "points.ply"
_PATIENCE = 300.0  # seconds after which a process is taken to hang
_PROCESSES = multiprocessing.get_context("forkserver")  # which has imported torch once for all of them
_PROCESSES.set_forkserver_preload(["kgs.datasets", "kgs.fit.run"])


def measure_faults(
    out: Path, *, quick: bool = False, seed: int = 0, say: Callable[[str], None] = print
) -> dict[str, Any]:
    """Measure, and write faults.csv, faults.json and faults.md.

    Args:
        out: folder for the results, made if it is not there.
        quick: 5 kills instead of 30, and memory over 200 steps instead of 2000.
        seed: of the moments at which processes are killed.
        say: where lines for the user go.

    Returns:
        What faults.json holds: the rows, how many failed, and versions.
    """
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        _write_points(root / POINTS)
        say("a fit that is left alone ...")
        _finish(root / "alone")
        expected = (root / "alone" / "splat.ply").read_bytes()
        say("kill -9 ...")
        rows = [_killed(root / "killed", expected, 5 if quick else 30, random.Random(seed), say)]
        say("SIGTERM ...")
        rows.append(_terminated(root / "terminated", expected))
        say("a full disk ...")
        rows.append(_full_disk(root / "full", expected))
        say("memory ...")
        rows += _memory(root / POINTS, 200 if quick else 2000)
    failed = sum(row["verdict"] != "met" for row in rows)
    result = {"rows": rows, "failed": failed, "versions": versions()}
    write_csv(out / "faults.csv", rows)
    write_json(out / "faults.json", result)
    cells = [[row["fault"], row["trials"], row["lost"], row["found"], row["verdict"]] for row in rows]
    heads = ("trials", "lost", "what was found", "verdict")
    (out / "faults.md").write_text(table := markdown_table("Faults of long fits", heads, cells, first="fault"))
    say(table)
    return result


def _write_points(path: Path) -> None:
    """Few first points before the cameras, so that there is much to add."""
    import numpy as np
    import trimesh

    points = np.random.default_rng(0).uniform((-2, -1.5, 3), (2, 1.5, 7), (300, 3))
    trimesh.PointCloud(points, np.full((300, 4), 128, np.uint8)).export(path)


def _row(fault: str, trials: int, lost: int, found: str, met: bool) -> dict[str, Any]:
    return {"fault": fault, "trials": trials, "lost": lost, "found": found, "verdict": "met" if met else "FAILED"}


def _fit(out: Path, limit: int | None) -> None:
    """The fit, in a process of its own; with a limit on the size of files from step 100 on."""
    import torch

    from kgs.datasets import synthetic_scene
    from kgs.fit import run
    from kgs.fit.trainer import Trainer

    torch.set_num_threads(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the progress lines
    scene = synthetic_scene(train_views=3, test_views=1, size=SIZE, seed=0)
    evaluate = Trainer.psnr
    started = out.with_suffix(".started")

    def psnr(trainer: Trainer, views: Any) -> float | None:  # measuring the curve is not what is tested
        started.touch()
        if limit is not None and trainer.step >= 100:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        return evaluate(trainer, views) if trainer.step == trainer.config.steps else None

    Trainer.psnr = psnr  # type: ignore[assignment,method-assign]
    try:
        _, stopped_by = run.fit_scene(
            scene, replace(CONFIG, init="file", init_file=out.parent / POINTS), out, resume=True, say=lambda line: None
        )
    except OSError:
        os._exit(1)  # as the command does, with one line
    if stopped_by:
        os._exit(128 + stopped_by)


def _start(out: Path, limit: int | None = None) -> BaseProcess:
    out.with_suffix(".started").unlink(missing_ok=True)
    process = _PROCESSES.Process(target=_fit, args=(out, limit))
    process.start()
    return process


def _finish(out: Path) -> None:
    """Run the fit to its end, from where it is."""
    process = _start(out)
    process.join(_PATIENCE)
    if process.exitcode != 0:
        process.kill()
        raise RuntimeError(f"{out}: expected the fit to end with 0, got {process.exitcode}")


def _wait_for_steps(out: Path, process: BaseProcess) -> bool:
    """Whether the fit got to a step before it ended."""
    started, end = out.with_suffix(".started"), time.monotonic() + _PATIENCE
    while process.is_alive() and not started.exists() and time.monotonic() < end:
        time.sleep(0.005)
    return process.is_alive()


def _killed(
    out: Path, expected: bytes, trials: int, moments: random.Random, say: Callable[[str], None]
) -> dict[str, Any]:
    """One fit after the other, killed again and again, each time resumed from what it left."""
    from kgs.fit.checkpoint import load_checkpoint, newest_checkpoint
    from kgs.fit.run import CHECKPOINT

    path, corrupt, fallen_back, different, fits, kills = out / CHECKPOINT, 0, 0, 0, 0, 0
    while kills < trials:
        process = _start(out)
        if _wait_for_steps(out, process):
            time.sleep(moments.uniform(0.0, 0.6))
            process.kill()
            kills += 1
            say(f"{kills} of {trials}")
        process.join(_PATIENCE)
        if process.exitcode == 0:  # it was done before
            different += (out / "splat.ply").read_bytes() != expected
            fits += 1
            shutil.rmtree(out)
            continue
        if not out.exists() or not any(out.glob("checkpoint*.pt")):
            continue
        try:
            load_checkpoint(path)
        except DataError:
            fallen_back += 1
        try:
            newest_checkpoint(path)
        except DataError:
            corrupt += 1
    _finish(out)
    different += (out / "splat.ply").read_bytes() != expected
    found = f"{fallen_back} times the previous checkpoint, {fits + 1} fits ended, {different} of them in other bits"
    return _row("kill -9 at a random moment", trials, corrupt, found, corrupt == different == 0)


def _terminated(out: Path, expected: bytes) -> dict[str, Any]:
    process = _start(out)
    running = _wait_for_steps(out, process)
    process.terminate()
    process.join(_PATIENCE)
    code = process.exitcode
    _finish(out)
    same = (out / "splat.ply").read_bytes() == expected
    found = f"exit code {code}, results written; resumed: {'the same' if same else 'other'} bits"
    met = running and code == 128 + signal.SIGTERM and same
    return _row("SIGTERM", 1, int(not same), found, met)


def _full_disk(out: Path, expected: bytes) -> dict[str, Any]:
    """No file may grow beyond 16 KiB from step 100 on: checkpoints cannot be written any more, nor the results."""
    from kgs.fit.checkpoint import newest_checkpoint
    from kgs.fit.run import CHECKPOINT

    process = _start(out, limit=2**14)
    process.join(_PATIENCE)
    code = process.exitcode
    try:
        step = newest_checkpoint(out / CHECKPOINT)[0]["step"]
    except DataError:
        step = -1
    partial = [path.name for path in out.glob("*.partial")]
    _finish(out)
    same = (out / "splat.ply").read_bytes() == expected
    found = f"the checkpoint of step {step} is whole, {len(partial)} partial files; resumed: "
    found += f"{'the same' if same else 'other'} bits"
    return _row("full disk", 1, int(step < 0), found, code != 0 and step > 0 and not partial and same)


def _memory(points: Path, steps: int) -> list[dict[str, Any]]:
    """Growth over the second half of a fit whose number of Gaussians stays, and the peak under a budget."""
    with _PROCESSES.Pool(1) as pool:
        slope, peak, ceiling = pool.apply(_memory_of, (points, steps))
    return [
        _row(f"memory, {steps} steps", 1, 0, f"grows by {slope:+.2f} KiB a step over the second half", slope < 1.0),
        _row(
            f"memory ceiling, {steps} steps",
            1,
            0,
            f"at most {peak / 2**20:.0f} MiB over the start, {ceiling / 2**20:.0f} MiB foretold",
            peak <= ceiling,
        ),
    ]


def _memory_of(points: Path, steps: int) -> tuple[float, int, int]:
    """Growth in KiB a step, the peak of the resident memory over that at the start, and the bound, in bytes."""
    import torch

    from kgs.datasets import synthetic_scene
    from kgs.fit.run import choose_points
    from kgs.fit.trainer import Trainer

    torch.set_num_threads(1)
    scene = synthetic_scene(train_views=3, test_views=1, size=SIZE, seed=0)
    config = replace(CONFIG, steps=steps, evaluations=1, init="file", init_file=points, max_bytes=2**22)
    trainer = Trainer(scene, config, choose_points(scene, config))
    before, resident = _resident(), []

    def note(trainer: Trainer, _: float) -> bool:
        resident.append(_resident())
        return False

    trainer.fit(note)
    half = resident[len(resident) // 2 :]
    middle = len(half) // 2
    slope = (sum(half[middle:]) / len(half[middle:]) - sum(half[:middle]) / middle) / middle
    return slope / 1024, max(resident) - before, trainer.most_bytes


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
