"""Runs one fit: makes initial points, trains with a progress line, evaluates, and writes all results."""

import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from kgs.datasets.scene import Scene
from kgs.errors import DataError, printable
from kgs.init_points import InitialPoints, initial_points
from kgs.init_points.in_view import check_in_view
from kgs.io.console import Stage, each, progress, say, silent
from kgs.io.figures import write_curve
from kgs.io.outputs import check_folder, png_names, write_png
from kgs.io.ownership import is_own
from kgs.io.ply import save_ply
from kgs.io.results_folder import CHECKPOINT, fit_staging, is_finished, locked, previous, replaced_files
from kgs.json_files import write_json
from kgs.machine import check_tools, peak_rss_mb, versions
from kgs.metrics.coverage import measure_coverage
from kgs.metrics.evaluate import evaluate
from kgs.metrics.lpips import Lpips

from .checkpoint import save_checkpoint
from .config import FitConfig
from .exports import write_exports
from .probes import decide
from .prune import prune
from .trainer import Trainer

_SAVE_SECONDS = 60.0
_INIT_NOTES = {
    "model-points": "points seen in training views, but their positions were refined with test views",
    "scene": "initial points that come with the layout",
    "file": "initial points of a file",
}
_CONVENTIONS = {
    "psnr": "mean over views, renders clamped to [0, 1], all pixels and channels",
    "ssim": "Kornia, 11 x 11, reflect padded; ssim_zero_padded as the published tables",
    "lpips": "VGG16 v0.1, inputs in [-1, 1]; lpips_vgg_unscaled with inputs in [0, 1] as the published tables",
    "test_views_used_for": "metrics and the curve only; no early stopping",
}


class Finished(NamedTuple):
    """A fit whose results are written, but do not yet replace those of a former fit."""

    folder: Path  # where the new results are
    out: Path  # where they belong
    trainer: Trainer
    metrics: dict[str, Any]  # what metrics.json holds
    settings: dict[str, Any]  # what config.json holds


def fit_scene(
    scene: Scene,
    config: FitConfig,
    out: str | PathLike[str],
    *,
    resume: bool = False,
    lpips: Lpips | None = None,
    request: dict[str, Any] | None = None,
    before_publish: "Callable[[Finished], None] | None" = None,
    say: Callable[[str], None] = say,
) -> tuple[dict[str, Any], int]:
    """Fit a scene and write all results of `kgs fit` but the page: splat, film, metrics, test images and checkpoints.

    New results are collected in `out/unfinished`, and replace those of a former fit only when all are there. A fit that
    a signal stopped writes its results too, but does not replace those of a finished fit.

    Args:
        scene: posed training and test views.
        config: the settings of the fit.
        out: the folder for the results, created if it does not exist.
        resume: continue from the folder's checkpoint, if there is one.
        lpips: the perceptual metric, or None to leave it out.
        request: the arguments of `load_scene` by name, its path as "scene", for config.json; without them `kgs eval`
            refuses the folder.
        before_publish: called with the finished fit when all other files are written, and before they replace those
            of a former fit; `kgs fit` passes `kgs.page.fit_page.write_own_page`, which adds the page.
        say: called with each line for the user.

    Returns:
        The content of metrics.json, and the signal that interrupted the fit or 0. Results are valid in both cases.

    Raises:
        DataError: the checkpoint is damaged or belongs to another fit, images are too small, another fit is at work in
            `out`, or `out` cannot be written to or holds files that kgs did not write and would overwrite.
        TrainingDiverged: a number is not finite, or a scale explodes; the last checkpoint is kept.
        OSError: a result cannot be written.
        ValueError: the device cannot be used, or the backend does not run on it.
        ModuleNotFoundError: the backend is numba or triton, which is not installed; or a package of the extra `app` is
            missing.
    """
    check_tools(config.device, config.backend, "jinja2", "matplotlib")  # even what is used only after training
    out = Path(out)
    smallest = max(16 if lpips else 6, 12 if config.coarse else 6)
    for views in (scene.train, scene.test):
        height, width = views.images.shape[-2:]
        if min(height, width) < smallest:
            reason = f"expected at least {smallest}x{smallest} pixels, got {width}x{height}"
            raise DataError(scene.root, "images", reason)
    names = png_names([*scene.train.names, *scene.test.names])
    try:
        check_folder(out, [*replaced_files(out), *(f"test/{names[view]}" for view in scene.test.names)], scene.root)
    except OSError as error:
        raise DataError(out, "", f"expected a folder that results can be written to ({error.strerror})") from error
    with locked(out):
        staging = fit_staging(out)
        staging.complete()
        new = staging.unfinished
        trainer, source = _resumed(scene, config, out) if resume else (None, out)
        if trainer is not None:
            say(f"resumed at step {trainer.step}")
        else:
            if resume:
                say(f"{printable(out)}: there is nothing to resume: the fit starts at the beginning")
            if is_own(out / "splat.ply"):
                say(f"{printable(out)}: the fit there is replaced when this one is done; to go on with it, resume")
            points = choose_points(scene, config, each)
            say(f"initial points: {len(points.points)} ({points.kind})")
            config, needs = decide(scene, config, choose_points, each)
            trainer = Trainer(scene, config, points, needs)
        for note in trainer.notes:
            say(note)
        num_said = len(trainer.notes)
        is_trained = False
        try:
            if source != new:
                staging.start()
                save_checkpoint(new / CHECKPOINT, trainer.state_dict())  # initial points can take a minute
            settings = {"request": request or {}, "fit": trainer.config.to_dict(), "timetable": trainer.times._asdict()}
            settings |= {name: getattr(trainer, name) for name in ("max_gaussians", "near_plane", "extent")}
            write_json(new / "config.json", settings)
            stopped_by = train(trainer, new / CHECKPOINT)
            is_trained = True
            save_ply(new / "splat.ply", trainer.shown, offset=scene.offset)
            write_curve(new / "curve.png", {"": trainer.curve})
            write_exports(trainer, new, settings["request"].get("roll", 0.0))
            (new / "test").mkdir(exist_ok=True)
            for i, name in each(list(enumerate(scene.test.names)), "test pictures", "view"):
                render = trainer.render(scene.test.camera(i))[0]
                write_png(new / "test" / names[name], scene.test.as_photo(render))
            metrics = measure(trainer, lpips)
            write_json(new / "metrics.json", metrics)
            if before_publish is not None:
                before_publish(Finished(new, out, trainer, metrics, settings))
            if not trainer.is_saved:  # results and checkpoint belong together
                trainer.save(new / CHECKPOINT)
        except BaseException:
            if is_trained:
                for note in trainer.notes[num_said:]:
                    say(note)
                say(f"{printable(new)}: holds the results that could be written")
            elif not trainer.saved:
                shutil.rmtree(new, ignore_errors=True)
            raise
        if stopped_by and is_finished(out):
            kept = f"{printable(out)} keeps its finished fit; this one is in {printable(new)}"
            trainer.note(f"{kept}, where a resumed fit goes on")
        else:
            staging.seal()
            staging.complete()
        for note in trainer.notes[num_said:]:
            say(note)
    return metrics, stopped_by


def _resumed(scene: Scene, config: FitConfig, out: Path) -> tuple[Trainer | None, Path]:
    """Resume the interrupted fit in a results folder, or if there is none the finished one; None: there is neither.

    An interrupted fit with other settings is an error: it would be lost when the finished one is written again.
    """
    for folder in (fit_staging(out).unfinished, out):
        path = folder / CHECKPOINT
        if any(file.exists() for file in (path, previous(path))):
            return Trainer.resume(scene, config, path), folder
    return None, out


def measure(trainer: Trainer, lpips: Lpips | None = None) -> dict[str, Any]:
    """The content of metrics.json for one fit; None stands for what was not measured."""
    scene, config = trainer.scene, trainer.config
    init_note = _INIT_NOTES.get(config.init, "initial points from training views alone")
    poses = "poses as given (estimated with all views in real scenes, the field's protocol)"
    if trainer.poses is not None:
        poses += ", those of the training views refined by the fit"
    return {
        "test": evaluate(trainer.render, scene.test, lpips) if len(scene.test) else None,
        "train": evaluate(trainer.render, scene.train, lpips),
        "seen": measure_coverage(scene, trainer.render, trainer.median_depth),
        "curve": trainer.curve,
        "seconds": round(trainer.seconds, 2),
        "peak_rss_mb": peak_rss_mb() or None,
        "gaussians": len(trainer.shown),
        "needs": trainer.needs,
        "poses": None if trainer.poses is None else trainer.poses.moved(),
        "steps": trainer.step,
        "seed": config.seed,
        "drop": config.drop,
        "init": trainer.init,
        "backend": trainer.backend,
        "protocol": {
            "train": list(scene.train.names),
            "test": list(scene.test.names),
            "image_size": list(scene.train.images.shape[-2:]),
            "background": scene.background.tolist(),
            "init": f"{config.init}: {init_note}; {poses}",
            **_CONVENTIONS,
        },
        "versions": versions(),
    }


def choose_points(scene: Scene, config: FitConfig, stage: Stage = silent) -> InitialPoints:
    """Make the initial points that `config.init` asks for; a DataError if there are none, or no view shows one."""
    kind = config.init
    if kind in ("scene", "model-points"):
        if len(scene.points) == 0:
            reason = f"expected points of the layout itself for the init {kind!r}, got none"
            raise DataError(scene.root, "points", reason)
        check_in_view(scene.points, scene.train, scene.root)
        return InitialPoints(scene.points, scene.point_colors, scene.init_kind)
    views = scene.train if scene.finer is None else scene.finer
    rules: dict[str, Any] = {"seed": config.seed, "count": config.init_points, "draw": config.draw}
    rules["pixels"] = scene.train.images[:, 0].numel()
    rules |= {"file": config.init_file, "origin": scene.offset}  # files that kgs writes are in the world's coordinates
    start = initial_points(views, kind, stage=stage, backend=config.backend, **rules)
    check_in_view(start.points, scene.train, config.init_file or scene.root)
    return start


def train(trainer: Trainer, checkpoint: Path | None, title: str = "fit") -> int:
    """Train to the end with a progress line, and :func:`prune`; save checkpoints each minute and at evaluations.

    SIGINT (Ctrl-C), SIGTERM and SIGHUP end the training after the current step. Returns the number of that signal, or
    0. If a checkpoint cannot be written (a full disk), a note says so, and training goes on.
    """
    saved = time.monotonic()

    def save() -> None:
        nonlocal saved
        saved = time.monotonic()
        if checkpoint is not None:
            try:
                trainer.save(checkpoint)
            except OSError as error:
                trainer.is_saved = False
                trainer.note(f"step {trainer.step}: no checkpoint: {error}")

    with _interruptible() as stopped, progress(trainer.times.steps, title, trainer.step) as advance:

        def after_step(trainer: Trainer, loss: float) -> bool:
            advance(f"loss={loss:.4f}, {len(trainer.model)} Gaussians")
            if trainer.step in trainer.times.evaluate or time.monotonic() - saved > _SAVE_SECONDS:
                save()
            return bool(stopped)

        trainer.fit(after_step)
        prune(trainer)
        save()
    return stopped[0] if stopped else 0


@contextmanager
def _interruptible() -> Iterator[list[int]]:
    """Record SIGINT, SIGTERM and SIGHUP in the list that is yielded; a second one acts as usual.

    Ignored signals (nohup) stay ignored, and only the main thread can handle any.
    """
    received: list[int] = []
    usual: dict[int, Any] = {}  # the handlers that are replaced
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            handler = None if number is None else signal.getsignal(number)
            if number is not None and handler not in (None, signal.SIG_IGN):
                usual[number] = handler

    def record(number: int, _: object) -> None:
        received.append(number)
        signal.signal(number, usual[number])

    for number in usual:
        signal.signal(number, record)
    try:
        yield received
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
