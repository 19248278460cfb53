"""What the paper prints for our methods (published.csv): means over 8 scenes (Mip-NeRF 360: 7), the best of five runs.

H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting", CVPR 2025.
"""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from kgs._support.errors import ArgumentError, DataError

from .grid import Cell

# Columns benchmark, views, table (the main comparison first), method, psnr, ssim, lpips.
PUBLISHED = pd.read_csv(Path(__file__).with_name("published.csv"))
SCENES_OF = {
    "LLFF": ("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"),
    "Mip-NeRF 360": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    "Blender": ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
}
# The benchmark and the name in published.csv of table 1, 2, ..., as docs/sparse-views.md counts them.
TABLES = (
    ("LLFF", "comparison"),
    ("Mip-NeRF 360", "comparison"),
    ("Blender", "comparison"),
    ("LLFF", "rate and schedule"),
    ("LLFF", "selection"),
    ("LLFF", "L1"),
)
LAYOUTS = {"LLFF": "llff", "Mip-NeRF 360": "colmap", "Blender": "blender"}  # the folder of a benchmark's scenes


def benchmark_of(scene: str, views: int) -> str | None:
    """The paper's benchmark that has a scene with so many views, whatever its folder; None: no such."""
    known = set(PUBLISHED.benchmark[PUBLISHED.views == views])
    return next((name for name in known if scene.rpartition("/")[2] in SCENES_OF[name]), None)


def published(benchmark: str | None, views: int, method: str) -> str:
    """All different "PSNR / SSIM / LPIPS" that the paper prints for a method, with "or" between them; "-" for none."""
    lines = PUBLISHED.query("benchmark == @benchmark and views == @views and method == @method")
    figures = lines[["psnr", "ssim", "lpips"]].drop_duplicates().to_numpy()
    return " or ".join("{:.2f} / {:.3f} / {:.3f}".format(*line) for line in figures) or "-"


def published_difference(benchmark: str | None, views: int, method: str, base: str) -> str:
    """As `published`: PSNR of a method less that of another, in dB, of the same table if it has both."""
    lines = PUBLISHED.query("benchmark == @benchmark and views == @views").set_index("table")
    of_method = lines.psnr[lines.method == method]
    of_base = lines.psnr[lines.method == base]
    if of_base.empty or method == base:
        return "-"
    gains = [f"{psnr - of_base.get(table, of_base.iloc[0]):+.2f}" for table, psnr in of_method.items()]
    return " or ".join(dict.fromkeys(gains)) or "-"


def cells_of_table(cells: Sequence[Cell], table: int, data: Path) -> list[Cell]:
    """The cells whose figures the paper prints in one of its tables, in their order.

    Args:
        cells: those of the preset "paper".
        table: number of the table, from 1.
        data: the folder of the scenes.

    Raises:
        ValueError: there is no such table.
        DataError: no cell is of the table, since `data` has none of its scenes, or they have too few photos.
    """
    if not 1 <= table <= len(TABLES):
        raise ArgumentError("table", f"a number from 1 to {len(TABLES)}", table)
    benchmark, name = TABLES[table - 1]
    printed = PUBLISHED[(PUBLISHED.benchmark == benchmark) & (PUBLISHED.table == name)]
    settings = {*zip(printed.views, printed.method, strict=True)}
    layout = LAYOUTS[benchmark]
    chosen = [cell for cell in cells if (cell["views"], cell["method"]) in settings]
    chosen = [cell for cell in chosen if cell["scene"].startswith(f"{layout}/")]
    chosen = [cell for cell in chosen if benchmark_of(cell["scene"], cell["views"]) == benchmark]
    if not chosen:
        scenes = ", ".join(SCENES_OF[benchmark])
        expected = f"a scene of {benchmark} ({scenes}) with photos enough for table {table}"
        raise DataError(data / layout, "", expected, "none")
    return chosen
