"""The methods that the study compares, and which cells each preset has."""

from itertools import product
from pathlib import Path
from typing import Any

from kgs.bench.scenes import SYNTHETIC, check_scenes
from kgs.errors import DataError

from .cells import FULL
from .grid import Cell

OFF, PAPER, FIXED = MAIN = ("off", "progressive 0.2", "fixed 0.1")
_CONSTANT = {"drop_schedule": "constant"}
# The settings of each method's fit that are not the default's. Tables and plots keep this order.
METHODS: dict[str, dict[str, Any]] = {
    **{OFF: {"drop": 0.0}, PAPER: {"drop": 0.2}, FIXED: {"drop": 0.1} | _CONSTANT},
    **{f"progressive {rate}": {"drop": rate} for rate in (0.1, 0.3)},
    **{f"fixed {rate}": {"drop": rate} | _CONSTANT for rate in (0.05, 0.15, 0.2, 0.3)},
    **{by: {"drop": 0.2, "drop_by": by.replace(" ", "-")} for by in ("high gradient", "low gradient", "near", "far")},
    **{
        f"L1 {by} {weight}": {"drop": 0.0, "opacity_l1": weight, "opacity_l1_by": by}
        for by, weight in product(("gradient", "distance"), (0.001, 0.01))
    },
}
FAMILIES = {
    "Rates and schedules": ["progressive 0.1", "progressive 0.3", *(f"fixed {r}" for r in (0.05, 0.1, 0.15, 0.2, 0.3))],
    "Selected Gaussians dropped instead of random ones": [name for name, fit in METHODS.items() if "drop_by" in fit],
    "An L1 penalty on opacities instead of dropping": [name for name in METHODS if name.startswith("L1")],
}
EQUAL_MEAN_RATE = {"progressive 0.1": "fixed 0.05", "progressive 0.2": "fixed 0.1", "progressive 0.3": "fixed 0.15"}
# The scenes of the preset "cpu" and how many views each is given.
SCENES = {"llff/fern": 3, "llff/flower": 3, "colmap/trex": 3, "blender/lego": 8, "nerfstudio/fox": 12}
# Numbers of views for the preset "paper", by the folder that a scene lies in.
VIEWS = {"llff": (3, 6, 9), "blender": (8,), "colmap": (12, 24), "nerfstudio": (12, 24)}
_FITS: dict[str, dict[str, Any]] = {"quick": {"steps": 200, "max_gaussians": 12_000}}
_FITS |= {"cpu": {"steps": 2000}, "paper": {"steps": 10_000}}
Setting = tuple[str, int, str, str, int]  # scene, views, start, method, seed


def sparse_cells(preset: str, data: Path | None) -> list[Cell]:
    """The cells of a preset, the most telling ones first, those of one start together.

    Args:
        preset: "quick": the synthetic scene, minutes. "cpu": the five scenes of `SCENES` in a quarter of the pixels of
            504x378, 2000 steps; hours. "paper": 10 000 steps in full size on every scene below `data`; days on a CPU.
        data: the folder of the scenes: `llff/fern` and so on; DataError: None, or a scene is missing.
    """
    if preset not in _FITS:
        raise ValueError(f"preset: expected one of {list(_FITS)}, got {preset!r}")
    if preset == "quick":
        settings: list[Setting] = [(SYNTHETIC, 3, "dense", name, seed) for seed in range(3) for name in MAIN]
        settings += [(SYNTHETIC, 3, "dense", name, 0) for name in ("fixed 0.2", "far", "L1 distance 0.01")]
        settings += [(SYNTHETIC, 3, start, PAPER, 0) for start in ("sift", "random")]
    elif data is None:
        raise DataError(Path("KGS_DATA"), "", f"expected this environment variable for the preset {preset!r}, got none")
    else:
        settings = _cpu(data) if preset == "cpu" else _paper(data)
    downscale = 2.0 if preset == "cpu" else None
    keys = ("scene", "views", "start", "method", "seed")
    cells = [dict(zip(keys, setting, strict=True)) | {"downscale": downscale} for setting in settings]
    return [cell | {"fit": _FITS[preset] | METHODS[str(cell["method"])]} for cell in cells]


def _cpu(data: Path) -> list[Setting]:
    check_scenes(data, SCENES)
    fern, flower = "llff/fern", "llff/flower"
    settings: list[Setting] = []
    for seed in range(3):
        settings += [(s, n, start, m, seed) for s, n in SCENES.items() for start in _starts(s) for m in MAIN]
        settings += [(scene, views, "sift", PAPER, seed) for scene, views in SCENES.items()]
    settings += [(s, views, "dense", name, 0) for s, views, name in product((fern, flower), (6, 9), (OFF, PAPER))]
    settings += [(fern, 3, "dense", name, seed) for seed in range(3) for name in METHODS if name not in MAIN]
    bounds = ("random", "model-points", FULL)  # no fit may have the last two
    settings += [(fern, 3, start, PAPER, seed) for start in bounds for seed in range(3)]
    return settings + [(flower, 3, start, PAPER, 0) for start in bounds]


def _paper(data: Path) -> list[Setting]:
    folders = [path for path in sorted(data.glob("*/*")) if path.is_dir() and path.parent.name in VIEWS]
    if not folders:
        raise DataError(data, "", f"expected scenes in folders named {sorted(VIEWS)}, found none")
    return [
        (str(path.relative_to(data)), views, start, name, seed)
        for seed, path in product(range(5), folders)
        for views, start in product(VIEWS[path.parent.name], _starts(path.parent.name))
        for name in METHODS
        if name in MAIN or (path.parent.name == "llff" and views == 3)
    ]


def _starts(scene: str) -> tuple[str, ...]:
    """Where the main methods begin: at dense points; Blender scenes also at the layout's random ones, as published."""
    return ("dense", "scene") if scene.startswith("blender") else ("dense",)
