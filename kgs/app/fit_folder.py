"""What `kgs fit` does with a scene, in its order: training, files, page; then all is published."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from kgs._support.errors import printable
from kgs._support.json_files import write_json
from kgs.app.files.cameras import as_taken
from kgs.app.files.figures import write_curve
from kgs.app.files.fit_files import CHECKPOINT, former_fit, is_finished, step_of
from kgs.app.files.outputs import png_names, write_png
from kgs.app.files.results import Results
from kgs.app.page.fit_page import write_own_page
from kgs.datasets.scene import Scene
from kgs.fit.checkpoint import save_checkpoint
from kgs.fit.config import FitConfig
from kgs.fit.fit import Fit
from kgs.fit.measures import measure
from kgs.fit.plan import expected_memory
from kgs.fit.run import check_before_points
from kgs.fit.trainer import Trainer
from kgs.metrics.lpips import Lpips
from kgs.ply import save_ply

from .console import each, say
from .files.exports import write_exports
from .scene_request import SceneRequest
from .stages import Stages
from .training import Training

_TEST = "test"  # folder of the renders of test views


class Published(NamedTuple):
    """The end of `kgs fit`."""

    fit: Fit
    signal: int  # that ended the training, or 0
    folder: Path  # of the results: `out`, or one in it if a signal ended this fit and `out` has a better one


def fit_folder(
    scene: Scene,
    config: FitConfig,
    results: Results,
    request: SceneRequest,
    *,
    resume: bool = False,
    lpips: Lpips | None = None,
    held_out: dict[str, Any] | None = None,
    say: Callable[[str], None] = say,
    stages: Stages | None = None,
) -> Published:
    """Fit a scene and write all results of `kgs fit`: splat, film, page, metrics, test images and checkpoints.

    New results are collected in `results.work`, and replace those of a former fit only when all are there. A fit that a
    signal stopped writes its results too, but replaces neither a finished fit nor one that got further.

    Args:
        scene: posed training and test views.
        config: the settings of the fit.
        results: the folder for the results.
        request: how the scene was loaded, for config.json, and how the page shows it.
        resume: continue the fit in `results.work`, or if there is none that in `results.out`.
        lpips: the perceptual metric, or None to leave it out.
        held_out: the measures of :func:`kgs.app.held_out.measure_held_out`, for metrics.json and the page.
        say: called with each line for the user.
        stages: names the stages as they begin.

    Raises:
        DataError: the checkpoint is damaged or belongs to another fit, or images are too small.
        TrainingDiverged: a number is not finite, or a scale explodes; the last checkpoint is kept.
        OSError: a result cannot be written.
        ValueError: the device cannot be used, or the backend does not run on it.
        ModuleNotFoundError: the backend is numba or triton, which is not installed.
    """
    out = results.out
    work = results.work
    stages = Stages(say) if stages is None else stages
    check_before_points(scene, config, lpips is not None)
    former = _former(out, resume, say)
    notes = _Notes(say)

    def begin(trainer: Trainer) -> None:
        say(f"resumed at step {trainer.step}" if former else _expectation(trainer))
        results.begin()
        work.mkdir(exist_ok=True)
        notes.say_new(trainer)
        if not (work / CHECKPOINT).exists():
            save_checkpoint(work / CHECKPOINT, trainer.state_dict())  # initial points can take a minute
        write_json(work / "config.json", _settings(trainer, request))
        stages.begin("fit")

    if former is None:
        stages.begin("initial points")
    training = Training(work / CHECKPOINT, begun=begin)
    try:
        trainer, fit = training.fit(scene, config, former)
    except BaseException:
        if training.trainer is not None and not training.trainer.saved:
            results.discard("fit")
        raise
    try:
        stages.begin("film")
        fit = _write_results(fit, work, request, lpips, held_out)
        for note in fit.notes:
            trainer.state.note(note)
        stages.begin("page")
        write_own_page(work, out, fit, request, _settings(trainer, request))
        if not trainer.is_saved:  # results and checkpoint belong together
            trainer.save(work / CHECKPOINT, fit.part)
    except BaseException:
        notes.say_new(trainer)
        say(f"{printable(work)}: holds the results that could be written")
        raise
    folder = out
    is_done = trainer.step >= trainer.plan.schedule.steps
    if not is_done and (is_finished(out) or step_of(out) > trainer.step):
        folder = work
        kept = f"{printable(out)} keeps its {_state(out)}; this one is in {printable(work)}"
        trainer.state.note(f"{kept}, where a resumed fit goes on")
    else:
        has_own_photos = Path(scene.root).resolve() == work.resolve()
        results.publish("fit", *(["photos"] if has_own_photos else []))
    notes.say_new(trainer)
    return Published(fit, training.signal, folder)


def _state(folder: Path) -> str:
    """How far the fit in a folder is, in words."""
    return "finished fit" if is_finished(folder) else f"fit, which got to step {step_of(folder)}"


def _former(out: Path, resume: bool, say: Callable[[str], None]) -> Path | None:
    """The checkpoint that the fit goes on from; None for one that begins, and says so where there is another."""
    folder = former_fit(out)
    if resume and folder is not None:
        return folder / CHECKPOINT
    if resume:
        say(f"{printable(out)}: there is nothing to resume: the fit starts at the beginning")
    elif folder is not None:
        until = "this one is done" if is_finished(out) else "this one is done or gets further"
        say(f"{printable(out)}: keeps its {_state(out)}, until {until}; to go on with it, use --resume")
    return None


def _expectation(trainer: Trainer) -> str:
    """What a fit begins with and how much memory it takes, in words."""
    init = trainer.state.start.init
    memory = expected_memory(trainer.scene, trainer.plan.max_gaussians)
    return f"initial points: {init['points']} ({init['kind']}); the fit takes up to {memory / 2**30:.1f} GiB of memory"


class _Notes:
    """Says the notes of a trainer, each once."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._count = 0

    def say_new(self, trainer: Trainer) -> None:
        """Say the notes that are new."""
        for note in trainer.state.notes[self._count :]:
            self._say(note)
        self._count = len(trainer.state.notes)


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
    fit: Fit, folder: Path, request: SceneRequest, lpips: Lpips | None, held_out: dict[str, Any] | None
) -> Fit:
    """Write splat, exports, pictures and measures; returns the fit with its metrics."""
    scene = fit.scene
    names = png_names([*scene.train.names, *scene.test.names])
    save_ply(folder / "splat.ply", fit.model, offset=scene.offset)
    write_curve(folder / "curve.png", {"": fit.history["curve"]})
    notes = write_exports(fit, folder, request.roll)
    (folder / _TEST).mkdir(exist_ok=True)
    for i, name in each(list(enumerate(scene.test.names)), "test pictures", "view"):
        picture = scene.test.as_photo(i, fit.test_renders[i].image[0])
        write_png(folder / _TEST / names[name], as_taken(picture, scene.test, i))
    metrics = measure(fit, lpips) | ({"held_out": held_out} if held_out else {})
    write_json(folder / "metrics.json", metrics)
    return fit.annotated(metrics=metrics, notes=(*fit.notes, *notes))
