"""What `kgs demo`, `fit` and `eval` do; options are arguments. Checks come before work and heavy imports."""

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from kgs.errors import DataError, printable
from kgs.io.console import VIEWER, as_line, say, say_next

from .config import DEMO, Backend, Background, FitConfig


def demo(
    *,
    out: Path = Path("demo"),
    steps: int = DEMO.steps,
    size: tuple[int, int] = (189, 252),
    seed: int = 0,
    device: str = "cpu",
    backend: Backend = "auto",
) -> None:
    """Fit three photos of a built-in room without and with DropGaussian, and compare views that were not used.

    For example:
      kgs demo -o demo
      kgs demo -o demo1 --seed 1

    Args:
        out: folder for index.html, demo.png, curve.png, metrics.json, splat.ply and .glb, cameras.json and
            turntable.webm.
        steps: training steps of each of the two fits; the default takes a minute on 2 cores, without numba 3.
        size: height and width of the pictures.
        seed: the scene, the first points and both fits derive from it.
        device: cpu, cuda, ...
        backend: as of kgs fit.
    """
    from kgs.datasets import synthetic_scene
    from kgs.io.outputs import EXPORTS, check_folder
    from kgs.machine import check_tools

    from .demo import run_demo

    config = replace(DEMO, seed=seed, steps=steps, device=device, backend=backend)
    if min(size) < 12:  # the window of SSIM
        raise ValueError(f"size: expected at least 12 pixels a side, got {size[0]} {size[1]}")
    check_tools(device, backend, "matplotlib", "jinja2")
    check_folder(out, ["index.html", "demo.png", "curve.png", "metrics.json", "splat.ply", *EXPORTS])
    runs = run_demo(synthetic_scene("room", train_views=3, test_views=5, size=size, seed=seed), config, out)
    say(f"\n{'':22}{'PSNR':>8}{'SSIM':>8}{'train PSNR':>12}{'Gaussians':>11}{'seconds':>9}")
    level = {name: [run[part]["psnr"] or math.inf for part in ("test", "train")] for name, run in runs.items()}
    for name, run in runs.items():
        columns = f"{level[name][0]:8.2f}{run['test']['ssim']:8.3f}{level[name][1]:12.2f}"
        say(f"{name + ' DropGaussian':<22}{columns}{run['gaussians']:11d}{run['seconds']:9.1f}")
    gain = level["with"][0] - level["without"][0]
    say(f"\ndifference on test views: {gain:+.2f} dB (one seed; try --seed 1, 2, ...)")
    say(f"pictures: {printable(out / 'demo.png')}, {printable(out / 'curve.png')}")
    say_next(
        f"open {as_line(out / 'index.html')} in a browser",
        "kgs fit PHOTOS -o OUT  # three or more photos of your own",
        VIEWER.format(as_line(out / "splat.ply")),
    )


def fit(
    scene: Path,
    /,
    *,
    out: Path,
    views: int | None = None,
    hold_out: int | None = None,
    downscale: float | None = None,
    background: Background = "black",
    preset: Literal["auto", "paper", "plain"] = "auto",
    fast: bool = False,
    resume: bool = False,
    estimate: bool = False,
    lpips_weights: Path | None = None,
    config: FitConfig,
) -> int:
    """Turn a folder of photos into a splat, with test metrics.

    For example:
      kgs fit PHOTOS -o OUT
      kgs fit fern -o fern-3 --views 3 --downscale 2

    Args:
        scene: a folder of 3 or more photos, whose cameras are found first (extra sfm) and written to the output folder
            (images, sparse/0, photos.json); or one with camera poses: LLFF, COLMAP, Blender or nerfstudio.
        out: folder for index.html, the page to look at, turntable.webm, a film, splat.ply and .glb, cameras.json,
            metrics.json, test/*.png, curve.png, config.json and the checkpoints.
        views: training views, spread over the views that are not held out; all of them unless given.
        hold_out: every Nth photo is for testing, not for training; 0 uses all. Unless given: the test photos that the
            scene's files name, or else every eighth; of fewer than 9 bare photos none.
        downscale: shrink the photos by this factor; bare ones on a CPU to 504 pixels unless given.
        background: behind photos with transparency.
        preset: auto: what the training views need, and no more. paper: DropGaussian's rule and recipe, as published,
            counts scaled. plain: the same without dropping. Each sets the defaults below, see --preset paper --help.
        fast: half the steps, a third of them on small pictures: other defaults, see --fast --help.
        resume: continue from the checkpoint in the output folder.
        estimate: of 4 or more bare photos: afterwards leave each out once, find cameras and fit anew without it, and
            measure it; takes a --fast fit for each photo.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is left out.
        config: every number of the fit.
    """
    del preset, fast  # kgs.cli has read them: they are the defaults of `config`
    from kgs.datasets.layouts import CAMERAS_REPORT
    from kgs.io.outputs import check_folder, is_own
    from kgs.io.results_folder import UNFINISHED, is_finished, taken
    from kgs.machine import check_tools
    from kgs.metrics.evaluate import in_words
    from kgs.metrics.lpips import Lpips
    from kgs.page.fit_page import write_own_page

    from .minutes import expected_minutes
    from .photos.entry import add_estimate, find_scene, is_bare, settle
    from .prune import left_out
    from .run import fit_scene

    if config.init_file is not None and not config.init_file.is_file():
        raise DataError(config.init_file, "", "expected a point cloud for --init-file, found no such file")
    check_tools(config.device, config.backend, "matplotlib", "safetensors", "jinja2")
    lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(config.device)
    check_folder(out, taken(out), scene, make=False)
    request = {"scene": os.path.abspath(scene), "train_views": views, "downscale": downscale, "background": background}
    request["hold_out"] = hold_out
    request["points"] = config.init if config.init == "model-points" else "none"
    place = out
    if bare := is_bare(scene):
        request, place = find_scene(scene, out, request, config, estimated=estimate)
    elif estimate:
        raise ValueError("estimate: expected a folder of bare photos, got a scene with cameras: see --hold-out")
    elif is_own(out / CAMERAS_REPORT):
        raise DataError(out, "", "holds cameras that kgs found for other photos: choose another folder with -o")
    loaded = _load(request, place)
    height, width = loaded.train.images.shape[-2:]
    say(f"{printable(scene)}: {len(loaded.train)} training and {len(loaded.test)} test views of {width}x{height}")
    minutes = expected_minutes(width * height, config)
    if minutes > 2 and config.device == "cpu" and config.minutes is None:
        say(f"expect about {minutes:.0f} minutes on a CPU; see --fast, --minutes, --downscale")
    options: dict[str, Any] = {"resume": resume, "lpips": lpips, "request": request}
    metrics, stopped_by = fit_scene(loaded, config, out, **options, before_publish=write_own_page)
    kept = bool(stopped_by) and is_finished(out)  # the former fit
    if bare and not kept:
        settle(out)
    if bare and estimate and not stopped_by:
        metrics = add_estimate(scene, out, loaded, config, background)
    say(in_words(metrics))
    posed = out if bare else scene
    splat, renders, by = (out / UNFINISHED if kept else out) / "splat.ply", out / "renders", request["downscale"]
    shrunk = ("--downscale", f"{by:g}") if by else ()
    say(f"{printable(splat)}: {metrics['gaussians']} Gaussians after {metrics['steps']} steps")
    if what := left_out(metrics["needs"]):
        say(f"left out: {what}")
    if stopped_by:
        say_next("the same command with --resume goes on where it stopped")
        return 128 + stopped_by
    say_next(
        f"open {as_line(out / 'index.html')} in a browser: the splat to look around in, and how good it is",
        f"{as_line('kgs', 'render', splat, '--cameras', posed, '-o', renders, *shrunk)}  # pictures from every camera",
        f"{as_line('kgs', 'eval', out, '--lpips-weights', 'WEIGHTS')}  # measure again, with LPIPS",
        VIEWER.format(as_line(splat)),
    )
    return 0


def evaluate(
    out: Path, /, *, lpips_weights: Path | None = None, device: str = "cpu", backend: Backend = "auto"
) -> None:
    """Measure a fit again and bring its metrics.json and page up to date; what is not measured stays as it is.

    For example:
      kgs eval fern-3
      kgs eval fern-3 --lpips-weights weights

    Args:
        out: the output folder of `kgs fit`.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is not measured.
        device: cpu, cuda, ...
        backend: auto: that of the fit.
    """
    from kgs.io.json_files import read_json, write_json
    from kgs.machine import check_tools
    from kgs.metrics.evaluate import in_words, measure_again
    from kgs.metrics.lpips import Lpips
    from kgs.page.fit_page import PAGE, refresh_page

    from .saved import load_fit

    check_tools(device, backend, "jinja2")
    lpips = None if lpips_weights is None else Lpips.load(lpips_weights).to(device)
    saved, path = load_fit(out, device), out / "metrics.json"
    saved = saved if backend == "auto" else saved._replace(backend=backend)
    scene = saved.placed(_load(saved.request, out))
    metrics = measure_again(path, read_json(path), scene, lambda c: saved.render(c, scene.background), lpips)
    write_json(path, metrics)
    refresh_page(out, saved, scene, metrics)
    say(in_words(metrics))
    say(f"{printable(path)} and {printable(out / PAGE)} are up to date")
    say_next(f"open {as_line(out / PAGE)} in a browser")


def _load(request: dict[str, Any], out: Path) -> Any:
    """The scene; the folder "." is that of the results itself."""
    from kgs.datasets import load_scene

    names = ("train_views", "downscale", "hold_out", "background", "points")
    scene = load_scene(out / request["scene"], **{name: request[name] for name in names})
    for note in scene.notes:
        say(note)
    return scene
