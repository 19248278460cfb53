"""What the paper prints for our methods, to be set beside our figures; the figures are in published.csv.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: its comparisons on LLFF, Mip-NeRF 360 and Blender, and its ablations on LLFF with three views. LPIPS is that
of unscaled inputs.

These are means over 8 scenes (Mip-NeRF 360: 7) at 504x378 (Blender: 400x400, Mip-NeRF 360: an eighth of each side)
after 10 000 steps, the best of five runs. They compare with ours in direction, not in level. The rate that grows to 0.2
is printed with two values for three views of LLFF, and the text has one for Mip-NeRF 360 that no table has. The paper
does not say which Gaussians "selective by gradient" and "by distance" drop, nor what its L1 penalties weigh: our
variants of each stand beside the same printed line.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pandas as pd

__all__ = ["benchmark_of", "published", "published_differences", "published_table"]

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


def published(benchmark: str | None, views: int, method: str) -> list[tuple[float, float, float]]:
    """All different PSNR, SSIM and LPIPS that the paper prints for a method, the main comparison's first."""
    lines = _lines(benchmark, views, method)[["psnr", "ssim", "lpips"]].drop_duplicates()
    return list(lines.itertuples(index=False, name=None))


def published_differences(benchmark: str | None, views: int, method: str, base: str) -> list[float]:
    """PSNR of a method less that of another in each table that has the first, in dB, each value once.

    A table that lacks the other takes it from the first that has it. Where none has it there is no difference.
    """
    lines, bases = (_lines(benchmark, views, name).set_index("table").psnr for name in (method, base))
    if bases.empty:
        return []
    return list(dict.fromkeys(round(psnr - bases.get(table, bases.iloc[0]), 2) for table, psnr in lines.items()))


def _lines(benchmark: str | None, views: int, method: str) -> pd.DataFrame:
    table = published_table()
    return table[(table.benchmark == benchmark) & (table.views == views) & (table.method == method)]
