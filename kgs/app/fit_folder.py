"""What `kgs fit` does, in its order: scene, initial points, training, files, page; then all is published."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from kgs._support.errors import DataError, printable
from kgs._support.json_files import write_json
from kgs._support.machine import check_packages
from kgs.app.files.cameras import as_taken
from kgs.app.files.figures import write_curve
from kgs.app.files.locks import locked
from kgs.app.files.outputs import check_folder, png_names, write_png
from kgs.app.files.publishing import UNFINISHED, discard, enter, publish, replacing
from kgs.app.files.results_folder import (
    CHECKPOINT,
    PREVIOUS,
    check_fit_files,
    discard_fit,
    has_fit,
    is_finished,
    step_of,
)
from kgs.app.page.fit_page import write_own_page
from kgs.datasets.scene import Scene
from kgs.fit.checkpoint import save_checkpoint
from kgs.fit.config import FitConfig, min_side
from kgs.fit.fit import Fit
from kgs.fit.measures import measure
from kgs.fit.plan import Plan, expected_memory, gaussian_limit, make_plan
from kgs.fit.pruning import prune
from kgs.fit.run import choose_points, decide
from kgs.fit.trainer import Trainer
from kgs.metrics.lpips import Lpips
from kgs.ply import save_ply

from .console import each, progress, say
from .files.exports import write_exports
from .scene_request import SceneRequest
from .stages import Stages

_SAVE_SECONDS = 60.0
_TEST = "test"  # folder of the renders of test views


class Published(NamedTuple):
    """The end of `kgs fit`."""

    fit: Fit
    signal: int  # that ended the training, or 0
    folder: Path  # of the results: `out`, or one in it if a signal ended this fit and `out` has a better one


def fit_folder(
    scene: Scene,
    config: FitConfig,
    out: str | PathLike[str],
    request: SceneRequest,
    *,
    resume: bool = False,
    lpips: Lpips | None = None,
    held_out: dict[str, Any] | None = None,
    say: Callable[[str], None] = say,
    stages: Stages | None = None,
) -> Published:
    """Fit a scene and write all results of `kgs fit`: splat, film, page, metrics, test images and checkpoints.

    New results are collected in the folder `unfinished` in `out`, and replace those of a former fit only when all are
    there. A fit that a signal stopped writes its results too, but replaces neither a finished fit nor one that got
    further.

    Args:
        scene: posed training and test views.
        config: the settings of the fit.
        out: the folder for the results, created if it does not exist.
        request: how the scene was loaded, for config.json, and how the page shows it.
        resume: continue the fit in `out/unfinished`, or if there is none that in `out`.
        lpips: the perceptual metric, or None to leave it out.
        held_out: the measures of :func:`kgs.app.held_out.measure_held_out`, for metrics.json and the page.
        say: called with each line for the user.
        stages: names the stages as they begin.

    Raises:
        DataError: the checkpoint is damaged or belongs to another fit, images are too small, kgs is at work on a fit in
            `out`, `out` cannot be written to or holds the files of a scene, what no fit wrote has the name of a result,
            or there is an unfinished fit and `resume` is False.
        TrainingDiverged: a number is not finite, or a scale explodes; the last checkpoint is kept.
        OSError: a result cannot be written.
        ValueError: the device cannot be used, or the backend does not run on it.
        ModuleNotFoundError: the backend is numba or triton, which is not installed; or a package of the extra `app` is
            missing.
    """
    out = Path(out)
    stages = Stages(say) if stages is None else stages
    check_packages("jinja2")  # even what is used only after training
    plan = make_plan(scene, config)
    _check_size(scene, config, lpips)
    names = png_names([*scene.train.names, *scene.test.names])
    _check_out(out, scene)
    with locked(out):
        check_fit_files(out, resume, [f"{_TEST}/{names[view]}" for view in scene.test.names])
        work = out / UNFINISHED
        trainer = _trainer(scene, config, plan, out, resume, say, stages)
        work.mkdir(exist_ok=True)
        notes = _Notes(trainer, say)
        is_trained = False
        try:
            if not (work / CHECKPOINT).exists():
                save_checkpoint(work / CHECKPOINT, trainer.state_dict())  # initial points can take a minute
            settings = _settings(trainer, request)
            with replacing(work, "fit") as new:
                write_json(new / "config.json", settings)
            stages.begin("fit")
            fit, stopped_by = train(trainer, work / CHECKPOINT)
            is_trained = True
            with replacing(work, "fit", keep_on_error=True) as new:
                stages.begin("film")
                fit = _write_results(fit, new, names, request, lpips, held_out)
                for note in fit.notes:
                    trainer.state.note(note)
                stages.begin("page")
                write_own_page(new, out, fit, request, settings)
                if not trainer.is_saved:  # results and checkpoint belong together
                    trainer.save(work / CHECKPOINT, fit.part)
            enter(work, "fit", (CHECKPOINT, PREVIOUS))
        except BaseException:
            if is_trained:
                notes.say_new()
                say(f"{printable(new)}: holds the results that could be written")
            elif not trainer.saved:
                discard_fit(work)
            raise
        folder = out
        is_done = trainer.step >= trainer.plan.schedule.steps
        if not is_done and (is_finished(out) or step_of(out) > trainer.step):
            folder = work
            kept = f"{printable(out)} keeps its {_state(out)}; this one is in {printable(work)}"
            trainer.state.note(f"{kept}, where a resumed fit goes on")
        else:
            if Path(scene.root).resolve() != work.resolve():
                discard(work, "photos")  # of another fit: those of this one are published with it
            publish(work, out)
        notes.say_new()
    return Published(fit, stopped_by, folder)


def _state(folder: Path) -> str:
    """How far the fit in a folder is, in words."""
    return "finished fit" if is_finished(folder) else f"fit, which got to step {step_of(folder)}"


def _check_size(scene: Scene, config: FitConfig, lpips: Lpips | None) -> None:
    """A DataError where images are too small for the measures."""
    smallest = min_side(config, lpips is not None)
    for views in (scene.train, scene.test):
        height, width = views.images.shape[-2:]
        if min(height, width) < smallest:
            reason = f"expected at least {smallest}x{smallest} pixels, got {width}x{height}"
            raise DataError(scene.root, "images", reason)


def _check_out(out: Path, scene: Scene) -> None:
    """Make the folder; a DataError where it cannot be written to, or holds the files of a scene."""
    try:
        check_folder(out, scene.root)
    except OSError as error:
        raise DataError(out, "", f"expected a folder that results can be written to ({error.strerror})") from error


def _trainer(
    scene: Scene, config: FitConfig, plan: Plan, out: Path, resume: bool, say: Callable[[str], None], stages: Stages
) -> Trainer:
    """A trainer that begins, or one that continues."""
    former = next((folder for folder in (out / UNFINISHED, out) if has_fit(folder)), None)
    if resume and former is not None:
        trainer = Trainer.resume(scene, config, former / CHECKPOINT)
        say(f"resumed at step {trainer.step}")
        return trainer
    if resume:
        say(f"{printable(out)}: there is nothing to resume: the fit starts at the beginning")
    elif former is not None:
        until = "this one is done" if is_finished(out) else "this one is done or gets further"
        say(f"{printable(out)}: keeps its {_state(out)}, until {until}; to go on with it, use --resume")
    stages.begin("initial points")
    points = choose_points(scene, config, each)
    plan = decide(plan, points)
    memory = expected_memory(scene, gaussian_limit(plan.config, len(points.points)))
    say(f"initial points: {len(points.points)} ({points.kind}); the fit takes up to {memory / 2**30:.1f} GiB of memory")
    return Trainer(scene, plan, points)


class _Notes:
    """Says the notes of a trainer, each once."""

    def __init__(self, trainer: Trainer, say: Callable[[str], None]) -> None:
        self._trainer = trainer
        self._say = say
        self._count = 0
        self.say_new()

    def say_new(self) -> None:
        """Say the notes that are new."""
        for note in self._trainer.state.notes[self._count :]:
            self._say(note)
        self._count = len(self._trainer.state.notes)


def _settings(trainer: Trainer, request: SceneRequest) -> dict[str, Any]:
    """The content of config.json."""
    return {
        "request": request.to_dict(),
        "fit": trainer.plan.config.to_dict(),
        "schedule": trainer.plan.schedule._asdict(),
        "max_gaussians": trainer.state.densifier.max_gaussians,
        "near_plane": trainer.state.start.near_plane,
        "extent": trainer.state.start.extent,
    }


def _write_results(
    fit: Fit,
    folder: Path,
    names: dict[str, str],
    request: SceneRequest,
    lpips: Lpips | None,
    held_out: dict[str, Any] | None,
) -> Fit:
    """Write all files but the page; returns the fit with its metrics."""
    scene = fit.scene
    save_ply(folder / "splat.ply", fit.model, offset=scene.offset)
    write_curve(folder / "curve.png", {"": fit.history["curve"]})
    notes = write_exports(fit, folder, request.roll)
    (folder / _TEST).mkdir()
    for i, name in each(list(enumerate(scene.test.names)), "test pictures", "view"):
        picture = scene.test.as_photo(i, fit.test_renders[i].image[0])
        write_png(folder / _TEST / names[name], as_taken(picture, scene.test, i))
    metrics = measure(fit, lpips) | ({"held_out": held_out} if held_out else {})
    write_json(folder / "metrics.json", metrics)
    return fit.annotated(metrics=metrics, notes=(*fit.notes, *notes))


def train(trainer: Trainer, checkpoint: Path | None, title: str = "fit") -> tuple[Fit, int]:
    """Train to the end with a progress line, and :func:`prune`; save checkpoints each minute and at evaluations.

    SIGINT (Ctrl-C), SIGTERM and SIGHUP end the training after the current step. Returns the fit and the number of that
    signal, or 0. If a checkpoint cannot be written (a full disk), a note says so the first time, and training goes on.
    """
    saved = time.monotonic()
    has_failed = False
    schedule = trainer.plan.schedule

    def save(part: dict[str, Any] | None = None) -> None:
        nonlocal saved, has_failed
        saved = time.monotonic()
        if checkpoint is not None:
            try:
                trainer.save(checkpoint, part)
            except OSError as error:
                if not has_failed:  # the next one is tried a minute later: no line for each
                    trainer.state.note(f"step {trainer.step}: no checkpoint: {error}")
                has_failed = True

    with _interruptible() as stopped, progress(schedule.steps, title, trainer.step) as advance:

        def after_step(trainer: Trainer, loss: float) -> bool:
            advance(f"loss={loss:.4f}, {len(trainer.model)} Gaussians")
            if trainer.step in schedule.evaluate or time.monotonic() - saved > _SAVE_SECONDS:
                save()
            return bool(stopped)

        fit = prune(trainer.fit(after_step))
        save(fit.part)
    return fit, stopped[0] if stopped else 0


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
