"""`kgs demo`: fits a built-in scene as `kgs fit` fits a scene, and to compare once more without DropGaussian."""

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from kgs._support.errors import printable, quantity
from kgs.app.console import VIEWER, as_line, open_in_browser, say, say_next, say_on_terminal
from kgs.app.files.results import Results
from kgs.fit.config import DROP, Backend, FitConfig

from .checks import check_side
from .options import Flag, IfGiven, Open, Out
from .tools import load_tools

if TYPE_CHECKING:
    from kgs.app.scene_request import SceneRequest
    from kgs.datasets.scene import Scene
    from kgs.fit.fit import Fit

_SHEET = "demo.png"  # held-out photos beside their renders
_WITHOUT = "without.json"  # the measures of the fit without dropping
# A fit, its page and its film in half a minute on two cores: of the photos, and of the room.
_STEPS = 350
BANANAS = FitConfig(
    steps=_STEPS,
    drop=DROP,
    sh_degree=0,
    exposure="same",
    coarse=0.7,
    init_points=30_000,
    max_gaussians=38_000,
    evaluations=4,
)
_ROOM = replace(BANANAS, coarse=0.3, init_points=12_000, max_gaussians=16_000)


def demo(
    *,
    out: Out = Path("demo"),
    scene: Literal["bananas", "room"] = "bananas",
    steps: int = _STEPS,
    size: IfGiven[int] = None,
    compare: Flag = False,
    resume: Flag = False,
    seed: int = 0,
    open_page: Open = False,
    device: str = "auto",
    backend: Backend = "auto",
) -> int:
    """Fit six photos of bananas, and measure the fit on two held-out photos.

    For example:
      kgs demo -o demo
      kgs demo -o demo1 --compare --seed 1

    Args:
        out: folder for the results. They are those of kgs fit, with the photos and their cameras, so that every command
            works on them; demo.png has held-out photos beside their renders.
        scene: bananas: photos by Piero Toffanin (dataset_banana, MIT licence), whose cameras were found from all eight.
            room: a synthetic one, three training and three held-out views.
        steps: training steps; all of the demo takes half a minute on 2 cores with the default.
        size: reduce the photos to this many pixels on their longer side. Unless given: their own size, 504.
        compare: fit a second time without DropGaussian, from the same initial points. For most seeds the two differ
            little.
        resume: continue a demo that was stopped.
        seed: of everything random: the room, the initial points and the fits.
        open_page: open the page in a browser when the fit is done.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: the fastest that is installed. kgs fit --help-all describes the others.
    """
    from kgs.app.files.fit_files import begun_on_cpu

    if size is not None:
        check_side(size)
    with Results.open(out, "fit", beside=["photos"], resume=resume) as results:
        if resume and device == "auto" and begun_on_cpu(out):
            device = "cpu"  # on a GPU it would go on with other bits
        found = load_tools(device, backend, "jinja2", "safetensors")
        preset = _ROOM if scene == "room" else BANANAS
        config = replace(preset, seed=seed, steps=steps, device=str(found), backend=backend)

        from kgs._support.machine import device_name
        from kgs.app.demo_scene import CREDIT
        from kgs.app.fit_folder import fit_folder
        from kgs.app.stages import Stages
        from kgs.metrics.evaluate import as_text

        say(f"device: {device_name(found)}")
        request, loaded = _write_scene(scene, results, size, seed)
        height, width = loaded.train.images.shape[-2:]
        say(f"{quantity(len(loaded.train), 'training photo')} of {width}x{height}, {len(loaded.test)} held out")
        published = fit_folder(loaded, config, results, request, resume=resume, stages=Stages(say_on_terminal))
        if published.signal:
            say_next("the same command with --resume goes on where it stopped")
            return 128 + published.signal
        say(as_text(published.fit.metrics))
        _compare(published.fit, config if compare else None, request, results)
    if scene == "bananas":
        say(CREDIT)
    say(f"pictures: {printable(out / _SHEET)}, {printable(out / 'curve.png')}")
    say_next(
        f"open {as_line(out / 'index.html')} in a browser",
        "kgs fit PHOTOS -o OUT  # three or more photos of your own",
        VIEWER.format(as_line(out / "splat.ply")),
    )
    if open_page:
        open_in_browser(out / "index.html")
    return 0


def _write_scene(name: str, results: Results, size: int | None, seed: int) -> "tuple[SceneRequest, Scene]":
    """Write the photos to the folder of the new fit, and load them."""
    from kgs.app.demo_scene import SIDE, write_bananas, write_room
    from kgs.app.scene_request import SceneRequest
    from kgs.datasets.source import SceneSource

    results.begin()
    results.discard("photos")
    results.work.mkdir(exist_ok=True)
    if name == "room":
        write_room(results.work, size or SIDE, seed)
    else:
        write_bananas(results.work)
    reduced = 1.0 if name == "room" or size is None else max(1.0, SIDE / size)
    request = SceneRequest(".", downscale=reduced, title="kgs demo")
    return request, request.load(results.out, say, SceneSource(results.work))


def _compare(fit: "Fit", config: FitConfig | None, request: "SceneRequest", results: Results) -> None:
    """Write held-out photos beside their renders: with dropping, and with a `config` of a fit without, too."""
    from kgs._support.json_files import read_json, write_json
    from kgs.app.files.figures import write_curve, write_sheet
    from kgs.app.page.fit_page import PAGE, write_fit_page
    from kgs.app.training import Training
    from kgs.fit.measures import measure

    scene = fit.scene
    fits = {"with DropGaussian": fit}
    if config is not None:
        training = Training()
        _, plain = training.fit(scene, replace(config, drop=0.0))
        if training.signal:
            raise SystemExit(128 + training.signal)
        fits = {"without DropGaussian": plain.annotated(metrics=measure(plain)), **fits}
        _say_difference(fits)
    renders = {title: [image[0] for image in one.test_renders.images] for title, one in fits.items()}
    levels = list(map(_level, fit.metrics["test"]["views"]))
    worst = sorted(range(len(levels)), key=levels.__getitem__)[:2]
    with results.stage(keep=True) as new:
        write_sheet(new / _SHEET, scene.test, renders, sorted(worst))
        if config is not None:
            write_json(new / _WITHOUT, fits["without DropGaussian"].metrics)
            write_curve(new / "curve.png", {title: one.history["curve"] for title, one in fits.items()})
            write_fit_page(
                new / PAGE,
                request.title,
                fits,
                notes=["The viewer and the sliders show the fit with DropGaussian."],
                settings=read_json(results.out / "config.json"),
            )


def _say_difference(fits: "dict[str, Fit]") -> None:
    """A table of the two fits, and by how much they differ."""
    say(f"\n{'':22}{'PSNR':>8}{'SSIM':>8}{'train PSNR':>12}{'Gaussians':>11}")
    for title, fit in fits.items():
        test = fit.metrics["test"]
        columns = f"{_level(test):8.2f}{test['ssim']:8.3f}{_level(fit.metrics['train']):12.2f}"
        say(f"{title:<22}{columns}{len(fit.model):11d}")
    without, dropped = (_level(fit.metrics["test"]) for fit in fits.values())
    gain = f"{dropped - without:+.2f} dB"
    say(f"\ndifference on test views: {gain} of one seed; seeds differ by more (try --seed 1, 2, ...)")


def _level(measures: dict[str, Any]) -> float:
    """The PSNR among measures, in dB."""
    return math.inf if measures["psnr"] is None else float(measures["psnr"])
