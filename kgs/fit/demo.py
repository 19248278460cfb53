"""The demonstration: three views of a synthetic scene, with and without DropGaussian, from equal starts."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from kgs.datasets.scene import Scene
from kgs.ply import save_ply

from .config import DEMO, FitConfig
from .outputs import check_folder, write_curve, write_json, write_sheet
from .progress import each, say
from .run import choose_points, measure, train
from .trainer import Trainer


def run_demo(scene: Scene, out: Path, config: FitConfig = DEMO, *, say: Callable[[str], None] = say) -> dict[str, Any]:
    """Fit the same scene twice and compare on views that neither fit has seen.

    Writes demo.png, curve.png, metrics.json and splat.ply (of the fit with DropGaussian) to `out`, and returns what
    metrics.json holds: `{"without": run, "with": run}`. The fit without has drop = 0 and is equal otherwise, the first
    points and the order of views included.

    Raises:
        SystemExit: a signal ended a fit; its code is 128 + the number of the signal.
    """
    check_folder(out, ["demo.png", "curve.png", "metrics.json", "splat.ply"])
    points = choose_points(scene, config, each)
    height, width = scene.train.images.shape[-2:]
    say(f"{len(scene.train)} training and {len(scene.test)} test views of {width}x{height}")
    say(f"first points: {len(points.points)} ({points.kind})")
    runs, renders, curves = {}, {}, {}
    for name, fit in (("without", replace(config, drop=0.0)), ("with", config)):
        trainer, title = Trainer(scene, fit, points), f"{name} DropGaussian"
        if signal := train(trainer, None, title=title):
            raise SystemExit(128 + signal)
        runs[name], curves[title] = measure(trainer), trainer.curve
        renders[title] = [trainer.render(scene.test.camera(i))[0] for i in range(len(scene.test))]
    save_ply(out / "splat.ply", trainer.model, offset=scene.offset)
    write_json(out / "metrics.json", runs)
    write_curve(out / "curve.png", curves)
    levels = [math.inf if view["psnr"] is None else view["psnr"] for view in runs["without"]["test"]["views"]]
    worst = sorted(range(len(levels)), key=levels.__getitem__)[:2]
    write_sheet(out / "demo.png", scene.test, renders, sorted(worst))
    return runs
