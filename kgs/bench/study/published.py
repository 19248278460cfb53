"""What the paper prints for our methods, to be set beside our figures; the figures are in published.csv.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: means over 8 scenes (Mip-NeRF 360: 7), the best of five runs, LPIPS of unscaled inputs. It prints two values
for the rate that grows to 0.2 with three views of LLFF, and its text has one for Mip-NeRF 360 that no table has. It
does not say which Gaussians its selections by gradient and by distance drop, nor what its L1 penalties weigh: our
variants of each stand beside the same printed line.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pandas as pd

__all__ = ["benchmark_of", "published", "published_difference", "published_table"]

SCENES = {
    "LLFF": ("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"),
    "Mip-NeRF 360": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    "Blender": ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
}


@cache
def published_table() -> pd.DataFrame:
    """All printed figures: benchmark, views, table (the main comparison first), method, psnr, ssim, lpips."""
    return pd.read_csv(Path(__file__).with_name("published.csv"))


def benchmark_of(scene: str, views: int) -> str | None:
    """The paper's benchmark that has a scene with so many views, whatever the layout of its folder; None: no such."""
    name, table = scene.rpartition("/")[2], published_table()
    known = set(table.benchmark[table.views == views])
    return next((benchmark for benchmark, names in SCENES.items() if name in names and benchmark in known), None)


def published(benchmark: str | None, views: int, method: str) -> str:
    """All different "PSNR / SSIM / LPIPS" that the paper prints for a method, with "or" between them; "-" for none."""
    lines = _lines(benchmark, views, method)[["psnr", "ssim", "lpips"]].drop_duplicates()
    return " or ".join("{:.2f} / {:.3f} / {:.3f}".format(*line) for line in lines.to_numpy()) or "-"


def published_difference(benchmark: str | None, views: int, method: str, base: str) -> str:
    """PSNR of a method less that of another in each table that has the first, in dB, each once; "-" for none.

    A table that lacks the other takes it from the first that has it.
    """
    lines, bases = (_lines(benchmark, views, name).set_index("table").psnr for name in (method, base))
    if bases.empty or method == base:
        return "-"
    found = (f"{psnr - bases.get(table, bases.iloc[0]):+.2f}" for table, psnr in lines.items())
    return " or ".join(dict.fromkeys(found)) or "-"


def _lines(benchmark: str | None, views: int, method: str) -> pd.DataFrame:
    table = published_table()
    return table[(table.benchmark == benchmark) & (table.views == views) & (table.method == method)]
