"""The tables of the paper, as parts of the preset "paper"."""

from collections.abc import Sequence
from pathlib import Path

from kgs._support.errors import ArgumentError, DataError

from .grid import Cell
from .published import PUBLISHED, SCENES_OF, benchmark_of

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
    chosen = [
        cell
        for cell in cells
        if cell["scene"].startswith(f"{layout}/")
        and benchmark_of(cell["scene"], cell["views"]) == benchmark
        and (cell["views"], cell["method"]) in settings
    ]
    if not chosen:
        scenes = ", ".join(SCENES_OF[benchmark])
        expected = f"a scene of {benchmark} ({scenes}) with photos enough for table {table}"
        raise DataError(data / layout, "", expected, "none")
    return chosen
