"""The demonstration: one scene, fitted without and with DropGaussian from equal starts."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

from kgs.datasets.scene import Scene
from kgs.io.console import each, say
from kgs.io.figures import write_curve, write_sheet
from kgs.io.json_files import write_json
from kgs.io.ply import save_ply
from kgs.page.fit_page import PAGE, write_fit_page

from .config import FitConfig
from .exports import write_exports
from .run import choose_points, measure, train
from .trainer import Trainer


def run_demo(scene: Scene, config: FitConfig, out: Path) -> dict[str, dict[str, Any]]:
    """Fit a scene twice, write its pictures, page, files and the exports, and return what metrics.json holds."""
    points = choose_points(scene, config, each)
    height, width = scene.train.images.shape[-2:]
    say(f"{len(scene.train)} training and {len(scene.test)} test views of {width}x{height}")
    say(f"first points: {len(points.points)} ({points.kind})")
    runs, renders, curves = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    drawn, measured = dict[str, Any](), dict[str, Any]()
    for name, drop in (("without", 0.0), ("with", config.drop)):
        trainer, title = Trainer(scene, replace(config, drop=drop), points), f"{name} DropGaussian"
        if signal := train(trainer, None, title=title):
            raise SystemExit(128 + signal)
        runs[name], curves[title] = measure(trainer), trainer.curve
        drawn[title], measured[title] = trainer.render, runs[name]
        renders[title] = [trainer.render(scene.test.camera(i))[0] for i in range(len(scene.test))]
    save_ply(out / "splat.ply", trainer.shown, offset=scene.offset)
    write_exports(trainer, out)
    write_json(out / "metrics.json", runs)
    write_curve(out / "curve.png", curves)
    levels = [math.inf if view["psnr"] is None else view["psnr"] for view in runs["without"]["test"]["views"]]
    worst = sorted(range(len(levels)), key=levels.__getitem__)[:2]
    write_sheet(out / "demo.png", scene.test, renders, sorted(worst))
    notes = [f"The viewer and the sliders show the fit {title}."]
    write_fit_page(out / PAGE, "kgs demo", scene, trainer.shown, trainer.near_plane, drawn, measured, notes=notes)
    return runs
