"""What `kgs fit` does once its options are checked: cameras, photos, fit, and what is said of it."""

import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kgs._support.errors import ArgumentError, printable, quantity
from kgs.app.console import VIEWER, as_line, open_in_browser, say, say_next, say_on_terminal
from kgs.app.files.results import Results

from .checks import SMALLEST
from .size import with_size
from .unposed import find_scene, on_ctrl_c

if TYPE_CHECKING:
    from kgs.app.scene_request import SceneRequest
    from kgs.app.sfm.source import Source
    from kgs.datasets.scene import Scene
    from kgs.fit.config import FitConfig
    from kgs.fit.fit import Fit


def run_fit(
    source: "Source",
    results: Results,
    request: "SceneRequest",
    config: "FitConfig",
    size: int | str | None,
    *,
    frames: int | None,
    measure: bool,
    resume: bool,
    lpips_weights: Path | None,
    suggest_detail: bool,
    open_page: bool,
) -> int:
    """Find cameras if there are none, load the scene, fit it and say what to do next; the exit code.

    Args:
        source: what is fitted.
        results: the folder for the results.
        request: how the scene is loaded, but for its size.
        config: the settings of the fit.
        size: of the photos, as `--size` takes it.
        frames: to be taken from a video.
        measure: measure a photo that a second fit leaves out.
        resume: continue the fit that is there.
        lpips_weights: folder of the weights of LPIPS.
        suggest_detail: suggest a fit of larger photos where there are such.
        open_page: open the page in a browser.
    """
    import torch

    from kgs._support.machine import device_name
    from kgs.app.fit_folder import fit_folder
    from kgs.app.held_out import MIN_TO_MEASURE, measure_held_out
    from kgs.app.stages import Stages
    from kgs.init_points.files import read_points
    from kgs.metrics.lpips import Lpips

    if config.init_file is not None:
        with warnings.catch_warnings(action="ignore"):
            read_points(config.init_file)  # an error now, not once there are cameras
    lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(config.device)
    say(f"device: {device_name(torch.device(config.device))}")
    stages = Stages(say_on_terminal, source.is_unposed, measure)
    if source.scene is None:
        stages.begin("cameras")
        assert not isinstance(size, str)  # refused before
        request, scene_source = find_scene(source, results, request, config.seed, size, frames)
    else:
        scene_source = source.scene
        request = with_size(request, scene_source, size)
    scene = request.load(results.out, say, scene_source)
    _check_side(source, request, scene)
    height, width = scene.train.images.shape[-2:]
    kept = f"{quantity(len(scene.train), 'training photo')} of {width}x{height}"
    say(f"{printable(source.path)}: {kept}, {len(scene.test) or 'none'} held out")
    with on_ctrl_c("the cameras that were found are kept" if source.is_unposed else ""):
        held_out: dict[str, Any] = {}
        if measure and len(scene.train) < MIN_TO_MEASURE:
            say(f"other views are not measured: --measure needs at least {MIN_TO_MEASURE} photos")
        elif measure:
            stages.begin("measurement")
            held_out, signal = measure_held_out(request, scene_source, len(scene.train), config, lpips, say)
            if signal:
                say("stopped in the measurement: the fit was not begun", sys.stderr)
                return 128 + signal
        published = fit_folder(
            scene, config, results, request, resume=resume, lpips=lpips, held_out=held_out, stages=stages
        )
    _say_results(published.fit, published.folder)
    if published.signal:
        say_next("the same command with --resume goes on where it stopped")
        return 128 + published.signal
    _say_next_steps(results.out, max(height, width), request.full_side(scene) if suggest_detail else None)
    if open_page:
        open_in_browser(results.out / "index.html")
    return 0


def _check_side(source: "Source", request: "SceneRequest", scene: "Scene") -> None:
    """Refuse photos that are too small to be fitted."""
    height, width = scene.train.images.shape[-2:]
    if max(height, width) >= SMALLEST:
        return
    error = ArgumentError("downscale", f"at least {SMALLEST} pixels", f"photos of {width}x{height}")
    raise error.about(source.path, "images") if (request.downscale or 1.0) == 1.0 else error


def _say_results(fit: "Fit", folder: Path) -> None:
    """How good a fit is, and what was left out of it."""
    from kgs.fit.pruning import left_out
    from kgs.metrics.evaluate import as_text
    from kgs.metrics.outlines import doubt

    metrics = fit.metrics
    sizes = f"{quantity(metrics['gaussians'], 'Gaussian')} after {quantity(metrics['steps'], 'step')}"
    say(as_text(metrics))
    say(f"{printable(folder / 'splat.ply')}: {sizes}")
    if needless := left_out(fit.decisions):
        say(needless)
    if sentence := doubt(metrics["outlines"]):
        say(sentence)


def _say_next_steps(out: Path, side: int, full_side: int | None) -> None:
    """Suggest what to do with a fit of photos of `side` pixels, which there are up to `full_side` of."""
    more = f"the same command with --detail high fits {full_side} pixels instead of {side}, and takes longer"
    say_next(
        f"open {as_line(out / 'index.html')} in a browser: the splat to look around in, and how good it is",
        *([more] if full_side else []),
        f"{as_line('kgs', 'render', out, '-o', out / 'renders')}  # pictures from every camera",
        VIEWER.format(as_line(out / "splat.ply")),
    )
