"""The study of sparse views: DropGaussian on and off at equal starts, its schedules, its rivals, and the starts.

A grid over scenes, numbers of views, starts, methods and seeds. Finished cells are kept; the tables can be made of any
part of the grid.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from kgs.errors import DataError

from .grid import finished_rows, read_rows, run_grid
from .published import PAPER
from .scenes import SYNTHETIC, check_scenes
from .sparse_cell import FULL, sparse_cell
from .sparse_groups import FIXED, MAIN, OFF
from .sparse_report import write_report
from .workers import Cell

__all__ = ["METHODS", "PRESETS", "measure_sparse", "sparse_cells"]

METHODS: dict[str, dict[str, Any]] = {
    OFF: {"drop": 0.0},
    PAPER: {"drop": 0.2},
    FIXED: {"drop": 0.1, "drop_schedule": "constant"},
    "progressive 0.1": {"drop": 0.1},
    "progressive 0.3": {"drop": 0.3},
    "fixed 0.05": {"drop": 0.05, "drop_schedule": "constant"},
    "fixed 0.15": {"drop": 0.15, "drop_schedule": "constant"},
    "fixed 0.2": {"drop": 0.2, "drop_schedule": "constant"},
    "fixed 0.3": {"drop": 0.3, "drop_schedule": "constant"},
    "high gradient": {"drop": 0.2, "drop_by": "high-gradient"},
    "low gradient": {"drop": 0.2, "drop_by": "low-gradient"},
    "near": {"drop": 0.2, "drop_by": "near"},
    "far": {"drop": 0.2, "drop_by": "far"},
    "L1 gradient 0.001": {"drop": 0.0, "opacity_l1": 0.001, "opacity_l1_by": "gradient"},
    "L1 gradient 0.01": {"drop": 0.0, "opacity_l1": 0.01, "opacity_l1_by": "gradient"},
    "L1 distance 0.001": {"drop": 0.0, "opacity_l1": 0.001, "opacity_l1_by": "distance"},
    "L1 distance 0.01": {"drop": 0.0, "opacity_l1": 0.01, "opacity_l1_by": "distance"},
}
PRESETS = ("quick", "cpu", "paper")
# The scenes of the preset "cpu" and how many views each is given.
SCENES = {"llff/fern": 3, "llff/flower": 3, "colmap/trex": 3, "blender/lego": 8, "nerfstudio/fox": 12}
# Numbers of views for the preset "paper", by the folder that a scene lies in.
VIEWS = {"llff": (3, 6, 9), "blender": (8,), "colmap": (12, 24), "nerfstudio": (12, 24)}


def sparse_cells(preset: str, data: Path | None) -> list[Cell]:
    """The cells of a preset, the most telling ones first, those of one start together.

    Args:
        preset: "quick": the synthetic scene, minutes. "cpu": the five scenes of `SCENES` in a quarter of the pixels of
            504x378, 2000 steps; hours. "paper": 10 000 steps in full size on every scene below `data`; days on a CPU.
        data: the folder of the scenes: `llff/fern` and so on.

    Raises:
        ValueError: an unknown preset.
        DataError: the preset needs scenes and `data` is None or lacks them.
    """
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {list(PRESETS)}, got {preset!r}")
    if preset == "quick":
        return _quick_cells()
    if data is None:
        raise DataError(Path("KGS_DATA"), "", f"expected this environment variable for the preset {preset!r}, got none")
    return _cpu_cells(data) if preset == "cpu" else _paper_cells(data)


def measure_sparse(
    out: Path,
    preset: str = "quick",
    *,
    processes: int | None = None,
    scheduler: str | None = None,
    lpips_weights: Path | None = None,
    say: Callable[[str], None] = print,
) -> list[dict[str, Any]]:
    """Run the study or go on with it, and write sparse.jsonl and the report, also when it is interrupted.

    Args:
        out: folder for the results; cells that its sparse.jsonl has are not repeated.
        preset: which cells, see `sparse_cells`; the scenes lie in the folder of the environment variable KGS_DATA.
        processes: fits at a time, None for one a core; the seconds of a fit hold for that many at a time.
        scheduler: address of a Dask scheduler that runs the cells instead; its workers find scenes and weights under
            the same paths.
        lpips_weights: a folder with the weights of VGG16 and LPIPS; without it LPIPS is left out, for good: a cell
            that is there is not measured again.
        say: where lines for the user go.

    Returns:
        The lines of sparse.jsonl that belong to the preset.

    Raises:
        DataError: scenes are missing, or `out` holds the study of another preset, whose report would be overwritten.
    """
    folder = os.environ.get("KGS_DATA")
    cells = sparse_cells(preset, None if folder is None else Path(folder))
    weights = None if lpips_weights is None else os.path.abspath(lpips_weights)
    data = None if folder is None else os.path.abspath(folder)
    work = partial(sparse_cell, data=data, lpips_weights=weights)
    path = out / "sparse.jsonl"
    if read_rows(path) and not finished_rows(cells, path):
        raise DataError(
            path, "", f"expected cells of the preset {preset!r}, got others; give each preset its own folder"
        )
    try:
        run_grid(cells, work, path, scheduler=scheduler, processes=processes or os.cpu_count() or 1, say=say)
    finally:
        rows = finished_rows(cells, path)
        if rows:
            scenes = "" if preset == "quick" else "KGS_DATA=SCENES "
            weighed = "" if lpips_weights is None else " --lpips-weights WEIGHTS"
            write_report(rows, out, f"{scenes}kgs bench sparse --preset {preset}{weighed} -o OUT", len(cells))
    return rows


def _quick_cells() -> list[Cell]:
    fit = {"steps": 200, "max_gaussians": 12_000}
    cells = [_cell(SYNTHETIC, 3, "dense", name, seed, fit, None) for seed in range(3) for name in MAIN]
    cells += [_cell(SYNTHETIC, 3, "dense", name, 0, fit, None) for name in ("fixed 0.2", "far", "L1 distance 0.01")]
    return cells + [_cell(SYNTHETIC, 3, start, PAPER, 0, fit, None) for start in ("sift", "random")]


def _cpu_cells(data: Path) -> list[Cell]:
    check_scenes(data, SCENES)
    fit = {"steps": 2000}
    main = [
        cell
        for seed in range(3)
        for cell in (
            *(_cell(s, n, start, m, seed, fit, 2.0) for s, n in SCENES.items() for start in _starts(s) for m in MAIN),
            *(_cell(s, n, "sift", PAPER, seed, fit, 2.0) for s, n in SCENES.items()),
        )
    ]
    forbidden = [
        _cell(scene, 3, start, PAPER, seed, fit, 2.0)
        for scene in ("llff/fern", "llff/flower")
        for start in ("random", "model-points", FULL)
        for seed in range(3 if scene == "llff/fern" else 1)
    ]
    more = [
        _cell(scene, views, "dense", name, 0, fit, 2.0)
        for scene in ("llff/fern", "llff/flower")
        for views in (6, 9)
        for name in (OFF, PAPER)
    ]
    ablations = [
        _cell("llff/fern", 3, "dense", name, seed, fit, 2.0)
        for seed in range(3)
        for name in METHODS
        if name not in MAIN
    ]
    return main + more + ablations + forbidden


def _paper_cells(data: Path) -> list[Cell]:
    folders = [path for path in sorted(data.glob("*/*")) if path.is_dir() and path.parent.name in VIEWS]
    if not folders:
        raise DataError(data, "", f"expected scenes in folders named {sorted(VIEWS)}, found none")
    fit = {"steps": 10_000}
    return [
        _cell(str(path.relative_to(data)), views, start, name, seed, fit, None)
        for seed in range(5)
        for path in folders
        for views in VIEWS[path.parent.name]
        for start in _starts(path.parent.name)
        for name in METHODS
        if name in MAIN or (path.parent.name == "llff" and views == 3)
    ]


def _starts(scene: str) -> tuple[str, ...]:
    """Where the main methods begin: at dense points; Blender scenes also at the layout's random ones, as published."""
    return ("dense", "scene") if scene.startswith("blender") else ("dense",)


def _cell(
    scene: str, views: int, start: str, method: str, seed: int, fit: dict[str, Any], downscale: float | None
) -> Cell:
    return {
        "scene": scene,
        "views": views,
        "downscale": downscale,
        "start": start,
        "method": method,
        "seed": seed,
        "fit": fit | METHODS[method],
    }
