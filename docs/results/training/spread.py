"""What dropping does to a fit: how far fits of other seeds are from each other, and from the photos held out."""

import os
import statistics
from dataclasses import replace
from pathlib import Path

import torch
import tyro
from kornia.metrics import psnr
from torch import Tensor

from kgs.bench.output import Row, markdown_table, write_results
from kgs.bench.scenes import check_scenes
from kgs.datasets import load_scene
from kgs.datasets.scene import Scene
from kgs.fit.config import PRESETS, FitConfig
from kgs.fit.run import fit_scene

SCENES = ("llff/fern", "colmap/trex", "colmap/fortress")
VIEWS = 3
DOWNSCALE = 2.0
RECIPES = {
    "paper's, without dropping": PRESETS["plain"],
    "paper's": PRESETS["paper"],
    "default, without dropping": FitConfig(drop=0.0),
    "default": FitConfig(),
}


def spread(*, out: Path, seeds: int = 3) -> None:
    """Divide the squared error of test views into the spread over seeds and what the mean of all fits has as well.

    For example:
      KGS_DATA=SCENES python spread.py --out training

    Half an hour. Writes spread.csv, spread.json and spread.md.

    Args:
        out: folder for the results, made if it is not there.
        seeds: fits of each scene and recipe, at least 2.
    """
    data = Path(os.environ["KGS_DATA"])
    check_scenes(data, SCENES)
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for name in SCENES:
        scene = load_scene(data / name, VIEWS, DOWNSCALE)
        for recipe, config in RECIPES.items():
            print(f"{name}, {recipe} ...", flush=True)
            images = torch.stack([_test_images(scene, replace(config, seed=seed)) for seed in range(seeds)])
            rows.append({"scene": name, "recipe": recipe, "seeds": seeds} | parts(images, scene.test.images))
    heads = ["PSNR", "squared error, 1e-4", "spread, 1e-4", "PSNR of the mean image"]
    lines = [[row["scene"], row["recipe"], *(f"{row[head]:.2f}" for head in heads)] for row in rows]
    title = f"Fits of {seeds} seeds each"
    write_results(out / "spread", rows, markdown_table(title, ["recipe", *heads], lines, first="scene"))


def parts(images: Tensor, photos: Tensor) -> dict[str, float]:
    """The measures of renders `(S, V, 3, H, W)` of as many seeds beside the photos `(V, 3, H, W)`."""
    return {
        "PSNR": statistics.fmean(_psnr(image, photos) for image in images),
        "squared error, 1e-4": 1e4 * float((images - photos).square().mean()),
        "spread, 1e-4": 1e4 * float(images.var(0).mean()),
        "PSNR of the mean image": _psnr(images.mean(0), photos),
    }


def _psnr(images: Tensor, photos: Tensor) -> float:
    return statistics.fmean(float(psnr(image, photo, 1.0)) for image, photo in zip(images, photos, strict=True))


def _test_images(scene: Scene, config: FitConfig) -> Tensor:
    fit = fit_scene(scene, config)
    renders = [fit.render(scene.test.camera(view))[0] for view in range(len(scene.test))]
    return torch.stack(renders).clamp(0, 1)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(spread) or 0)
