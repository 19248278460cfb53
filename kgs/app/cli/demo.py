"""`kgs demo`: fits a built-in scene with DropGaussian, and to compare without it from the same initial points."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from kgs._support.errors import ArgumentError, printable
from kgs.app.console import VIEWER, as_line, each, say, say_next
from kgs.fit.config import DEMO, DEMO_STEPS, DROP, ROOM_DEMO, Backend, FitConfig

from .options import Out
from .tools import load_tools

if TYPE_CHECKING:
    from kgs.datasets.scene import Scene
    from kgs.fit.fit import Fit

PHOTOS = Path(__file__).parents[1] / "demo_photos"  # six training photos, two held out, and their cameras
PHOTO_SIZE = 335, 504  # their height and width
CREDIT = "Photos: Piero Toffanin, dataset_banana (MIT licence)."
MIN_SIDE = 12  # pixels: the window of SSIM


def demo(
    *,
    out: Out = Path("demo"),
    scene: Literal["bananas", "room"] = "bananas",
    steps: int = DEMO_STEPS,
    size: tuple[int, int] = (378, 504),
    compare: bool = False,
    seed: int = 0,
    device: str = "auto",
    backend: Backend = "auto",
) -> None:
    """Fit six photos of bananas, and measure the fit on two held-out photos.

    For example:
      kgs demo -o demo
      kgs demo -o demo1 --compare --seed 1

    Args:
        out: folder for index.html, demo.png, curve.png, metrics.json, splat.ply, .compressed.ply and .glb, cameras.json
            and turntable.webm (.mp4 where there is an encoder).
        scene: bananas: photos by Piero Toffanin (dataset_banana, MIT licence), whose cameras were found from all eight.
            room: a synthetic one, three training and three held-out views.
        steps: training steps; all of the demo takes half a minute on 2 cores with the default.
        size: height and width of the pictures; photos are reduced until they fit in, and never enlarged.
        compare: fit a second time without DropGaussian, from the same initial points. For most seeds the two differ
            little.
        seed: of everything random: the room, the initial points and the fits.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: the fastest that is installed. kgs fit --help-all describes the others.
    """
    from kgs.app.files.outputs import check_folder
    from kgs.app.files.publishing import check_free
    from kgs.app.files.results_folder import SPLAT_FILES

    preset = ROOM_DEMO if scene == "room" else DEMO
    config = replace(preset, seed=seed, steps=steps, backend=backend)
    check_size(scene, size)
    check_folder(out, make=False)
    check_free(out, "demo", (*SPLAT_FILES, "metrics.json", "curve.png", "demo.png"))
    found = load_tools(device, backend, "jinja2")

    from kgs._support.machine import device_name

    say(f"device: {device_name(found)}")
    config = replace(config, device=str(found))
    drops = {"without": 0.0, "with": DROP} if compare else {"with": DROP}
    notes = [CREDIT] if scene == "bananas" else []
    runs = run_demo(load_demo(scene, size, seed), config, out, drops, notes)
    say(f"\n{'':22}{'PSNR':>8}{'SSIM':>8}{'train PSNR':>12}{'Gaussians':>11}{'seconds':>9}")
    level = {name: [_level(run[part]) for part in ("test", "train")] for name, run in runs.items()}
    for name, run in runs.items():
        columns = f"{level[name][0]:8.2f}{run['test']['ssim']:8.3f}{level[name][1]:12.2f}"
        say(f"{name + ' DropGaussian':<22}{columns}{run['gaussians']:11d}{run['seconds']:9.1f}")
    if compare:
        gain = level["with"][0] - level["without"][0]
        say(f"\ndifference on test views: {gain:+.2f} dB of one seed; seeds differ by more (try --seed 1, 2, ...)")
    for note in notes:
        say(note)
    say(f"pictures: {printable(out / 'demo.png')}, {printable(out / 'curve.png')}")
    say_next(
        f"open {as_line(out / 'index.html')} in a browser",
        "kgs fit PHOTOS -o OUT  # three or more photos of your own",
        VIEWER.format(as_line(out / "splat.ply")),
    )


def load_demo(name: str, size: tuple[int, int], seed: int) -> "Scene":
    """The bananas or the room, in pictures of at most this height and width."""
    from kgs.datasets import load_scene, synthetic_scene

    if name == "room":
        return synthetic_scene(train_views=3, test_views=3, size=size, seed=seed)
    return load_scene(PHOTOS, downscale=_reduction(size))


def check_size(scene: str, size: tuple[int, int]) -> None:
    """Raise a ValueError where pictures of this size would be too small for the SSIM."""
    if min(size) < MIN_SIDE:
        raise ArgumentError(f"size: expected at least {MIN_SIDE} pixels a side, got {size[0]} {size[1]}")
    if scene == "bananas" and min(PHOTO_SIZE) / _reduction(size) < MIN_SIDE:
        min_width = math.ceil(MIN_SIDE * PHOTO_SIZE[1] / PHOTO_SIZE[0])
        raise ArgumentError(f"size: expected at least {MIN_SIDE} {min_width} for these photos, got {size[0]} {size[1]}")


def _reduction(size: tuple[int, int]) -> float:
    """The factor by which the photos are reduced to fit into this height and width."""
    return max(1.0, PHOTO_SIZE[0] / size[0], PHOTO_SIZE[1] / size[1])


def run_demo(
    scene: "Scene", config: FitConfig, out: Path, drops: dict[str, float], notes: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """Fit a scene once or twice, and write pictures, page and all other files; returns the content of metrics.json.

    Args:
        scene: with test views.
        config: of all fits, but for `drop`.
        out: folder of the files.
        drops: rates of dropping by the name of the run; pictures show the last one beside the others.
        notes: sentences for the page.
    """
    from kgs._support.json_files import write_json
    from kgs.app.files.exports import write_exports
    from kgs.app.files.figures import write_curve, write_sheet
    from kgs.app.files.publishing import replacing
    from kgs.app.fit_folder import train
    from kgs.app.page.fit_page import PAGE, write_fit_page
    from kgs.fit.measures import measure
    from kgs.fit.plan import make_plan
    from kgs.fit.run import choose_points
    from kgs.fit.trainer import Trainer
    from kgs.ply import save_ply

    points = choose_points(scene, config, each)
    height, width = scene.train.images.shape[-2:]
    say(f"{len(scene.train)} training and {len(scene.test)} test views of {width}x{height}")
    say(f"initial points: {len(points.points)} ({points.kind})")
    plan = make_plan(scene, config)
    Trainer(scene, plan, points).train_step()  # discarded: it compiles the kernels before the clock starts
    fits = dict[str, "Fit"]()
    runs = dict[str, Any]()
    for name, drop in drops.items():
        title = f"{name} DropGaussian"
        trainer = Trainer(scene, replace(plan, config=replace(plan.config, drop=drop)), points)
        fit, signal = train(trainer, None, title=title)
        if signal:
            raise SystemExit(128 + signal)
        runs[name] = measure(fit)
        fits[title] = fit.annotated(metrics=runs[name])
    levels = list(map(_level, runs[name]["test"]["views"]))
    worst = sorted(range(len(levels)), key=levels.__getitem__)[:2]
    renders = {title: [image[0] for image in one.test_renders.images] for title, one in fits.items()}
    shown = [f"The viewer and the sliders show the fit {title}."] if len(runs) > 1 else []
    with replacing(out, "demo", all_former=True) as new:
        save_ply(new / "splat.ply", fit.model, offset=scene.offset)
        for note in write_exports(fit, new):
            say(note)
        write_json(new / "metrics.json", runs)
        write_curve(new / "curve.png", {title: one.history["curve"] for title, one in fits.items()})
        write_sheet(new / "demo.png", scene.test, renders, sorted(worst))
        write_fit_page(
            new / PAGE,
            "kgs demo",
            fits,
            notes=[*shown, *notes],
        )
    return runs


def _level(measures: dict[str, Any]) -> float:
    """The PSNR among measures, in dB."""
    return math.inf if measures["psnr"] is None else float(measures["psnr"])
