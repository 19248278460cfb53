"""The methods that the study compares, and which cells each preset has."""

from collections.abc import Collection, Iterable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from kgs._support.errors import ArgumentError, DataError, quoted
from kgs.bench.scenes import SYNTHETIC, check_scenes
from kgs.datasets import load_scene
from kgs.fit.config import FitConfig

from .grid import Cell

OFF = "off"
PAPER = "progressive 0.2"
FIXED = "fixed 0.1"
MAIN = (OFF, PAPER, FIXED)
AUTO = "auto"  # kgs fit as it comes
AUTO_OFF = "auto, off"  # the same without dropping
AUTOS = (AUTO, AUTO_OFF)
SEEDS = range(3)
# The settings of each method's fit that are not those of the preset paper. Tables and plots keep this order.
METHODS: dict[str, dict[str, Any]] = {
    OFF: {"drop": 0.0},
    PAPER: {"drop": 0.2},
    FIXED: {"drop": 0.1, "drop_schedule": "constant"},
    AUTO: {"preset": "auto"},
    AUTO_OFF: {"preset": "auto", "drop": 0.0},
    **{f"progressive {rate}": {"drop": rate} for rate in (0.1, 0.3)},
    **{f"fixed {rate}": {"drop": rate, "drop_schedule": "constant"} for rate in (0.05, 0.15, 0.2, 0.3)},
    **{by: {"drop": 0.2, "drop_by": by.replace(" ", "-")} for by in ("high gradient", "low gradient", "near", "far")},
}
for _by, _weight in product(("gradient", "distance"), (0.001, 0.01)):
    METHODS[f"L1 {_by} {_weight}"] = {"drop": 0.0, "opacity_l1": _weight, "opacity_l1_by": _by}
FAMILIES = {
    "The default, with and without dropping": [AUTO, AUTO_OFF],
    "Rates and schedules": ["progressive 0.1", "progressive 0.3", *(f"fixed {r}" for r in (0.05, 0.1, 0.15, 0.2, 0.3))],
    "Selected Gaussians dropped instead of random ones": [name for name, fit in METHODS.items() if "drop_by" in fit],
    "An L1 penalty on opacities instead of dropping": [name for name in METHODS if name.startswith("L1")],
}
# The scenes of the preset "cpu" and how many views each is given; for "paper" the numbers by the scene's folder.
FORWARD = {"llff/fern": 3, "llff/flower": 3, "colmap/trex": 3}
OBJECTS = {"blender/lego": 8, "nerfstudio/fox": 12, "colmap/monstree": 8}
SCENES = FORWARD | OBJECTS
# Scenes that the preset "field" has, too, where they are there, each with as many views as it has photos for.
JOINED = {"colmap/family": (6,), "colmap/fortress": (3,), "colmap/kitchen": (12, 24), "colmap/fountain": (3, 6)}
# The scenes of the preset "guard": photos that face one way, a walk around a statue, objects.
GUARD = FORWARD | {"colmap/fortress": 3, "colmap/family": 6}
GUARD |= {"blender/lego": 8, "nerfstudio/fox": 12, "colmap/kitchen": 12}
MORE_VIEWS = [*product(("llff/fern", "llff/flower"), (6, 9)), ("nerfstudio/fox", 6), ("colmap/monstree", 12)]
VIEWS = {"llff": (3, 6, 9), "blender": (8,), "colmap": (12, 24), "nerfstudio": (12, 24)}
_FITS: dict[str, dict[str, Any]] = {
    "quick": {"steps": 200, "max_gaussians": 12_000},
    "cpu": {"steps": 2000},
    "field": {"steps": 2000},
    "paper": {"steps": 10_000},
    "guard": {"steps": 700},
}
Block = tuple[Iterable[int], Iterable[tuple[str, int]], Iterable[str], Iterable[str]]  # seeds, scenes, starts, methods


def sparse_cells(preset: str, data: Path | None) -> list[Cell]:
    """The cells of a preset, the most telling ones first, those of one start together.

    Args:
        preset: "quick", "cpu", "field", "paper" or "guard", as the help of `kgs study` says of them.
        data: the folder of the scenes: `llff/fern` and so on; DataError: None, or a scene is missing.
    """
    if preset not in _FITS:
        raise ArgumentError("preset", f"one of {list(_FITS)}", quoted(preset))
    if preset == "quick":
        scene = [(SYNTHETIC, 3)]
        blocks: list[Block] = [
            (SEEDS, scene, ["dense"], MAIN),
            ([0], scene, ["dense"], ("fixed 0.2", "far", "L1 distance 0.01")),
            ([0], scene, ["dense"], AUTOS),
            ([0], scene, ["sift", "random"], [PAPER]),
        ]
    elif data is None:
        raise DataError(Path("KGS_DATA"), "", f"this environment variable for the preset {preset!r}", "none")
    else:
        blocks_of = {"cpu": _cpu, "field": _field, "paper": _paper, "guard": _guard}
        blocks = blocks_of[preset](data)
    fits = {method: _FITS[preset] | settings for method, settings in METHODS.items()}
    if preset in ("field", "guard"):
        for method in AUTOS:
            fits[method]["steps"] = None  # their own number
    return [
        {"scene": scene, "views": views, "start": start, "method": method, "seed": seed}
        | {"downscale": 2.0 if preset in ("cpu", "guard") else None, "fit": fits[method]}
        for block in blocks
        for seed, (scene, views), start, method in product(*block)
    ]


def name_of(cell: Cell) -> str:
    """As "llff/fern, 3 views, dense, off, seed 0"; of one preset each cell has another name."""
    words = [cell["scene"], f"{cell['views']} views", cell.get("start"), cell["method"], f"seed {cell['seed']}"]
    return ", ".join(word for word in words if word)


def with_steps(cells: Iterable[Cell], steps: int) -> list[Cell]:
    """The cells with fits of so many steps, in place of their own number; ValueError: fewer than 1, or too many."""
    FitConfig(steps=steps)  # checks it
    return [cell | {"fit": cell["fit"] | {"steps": steps}} for cell in cells]


def select(
    cells: list[Cell],
    *,
    scenes: Collection[str] | None = None,
    methods: Collection[str] | None = None,
    views: Collection[int] | None = None,
    seeds: Collection[int] | None = None,
) -> list[Cell]:
    """The cells with one of these values, in their order; None: with any.

    Raises:
        ValueError: no cell has one of the values, or none has them together.
    """
    wanted = {"scenes": scenes, "methods": methods, "views": views, "seeds": seeds}
    chosen = cells
    for name, values in wanted.items():
        if values is None:
            continue
        key = name if name == "views" else name.removesuffix("s")
        there = list(dict.fromkeys(cell[key] for cell in cells))
        for value in values:
            if value not in there:
                raise ArgumentError(name, f"some of {there}", quoted(value))
        chosen = [cell for cell in chosen if cell[key] in values]
    if not chosen:
        given = {name: list(values) for name, values in wanted.items() if values is not None}
        raise ArgumentError("cells", f"one with {given}", "none", advice="--list shows all of them")
    return chosen


def _cpu(data: Path) -> list[Block]:
    """The six scenes in a quarter of the pixels."""
    check_scenes(data, SCENES)
    fern = [("llff/fern", 3)]
    rivals = [name for name in METHODS if name not in (*MAIN, *AUTOS)]
    bounds = ("random", "model-points")  # no fit may have the last one
    return [
        *_by_seed((scene, methods) for methods in (MAIN, AUTOS) for scene in SCENES.items()),
        *[([seed], MORE_VIEWS, ["dense"], methods) for seed in SEEDS for methods in ((OFF, PAPER), AUTOS)],
        *[([seed], SCENES.items(), ["sift"], [PAPER]) for seed in SEEDS],
        (SEEDS, [("blender/lego", 8)], ["scene"], MAIN),
        (SEEDS, fern, ["dense"], rivals),
        *[(SEEDS, fern, [start], [PAPER]) for start in bounds],
        *[([0], [(SYNTHETIC, 3)], ["dense"], methods) for methods in (MAIN, AUTOS)],  # pictures for the page
        ([0], [("llff/flower", 3)], bounds, [PAPER]),
    ]


def _field(data: Path) -> list[Block]:
    """The field's protocol: photos in the size that they have, every eighth held out. LLFF's are 504x378."""
    check_scenes(data, SCENES)
    more_views = [*product(FORWARD, (6, 9)), *_joined(data)]
    return [
        *_by_seed((scene, MAIN) for scene in FORWARD.items()),
        *_by_seed((scene, MAIN) for scene in OBJECTS.items()),
        *_by_seed((scene, AUTOS) for scene in SCENES.items()),
        *_by_seed(product(more_views, ((OFF, PAPER), AUTOS))),
    ]


def _joined(data: Path) -> list[tuple[str, int]]:
    there = {scene: counts for scene, counts in JOINED.items() if (data / scene).is_dir()}
    settings = [(scene, views) for scene, counts in there.items() for views in counts]
    return [(scene, views) for scene, views in settings if views <= _training_photos(data / scene)]


def _guard(data: Path) -> list[Block]:
    """Three methods with one seed; last the default's other seeds, which tell the noise of each scene."""
    check_scenes(data, GUARD)
    blocks: list[Block] = [([0], [scene], ["dense"], (*AUTOS, PAPER)) for scene in GUARD.items()]
    return [*blocks, ((1, 2), GUARD.items(), ["dense"], [AUTO])]


def _paper(data: Path) -> list[Block]:
    """All scenes with all numbers of views that they have photos for; `too_few_photos` names the others."""
    folders = _scenes_of_paper(data)
    if not folders:
        raise DataError(data, "", f"scenes in folders named {sorted(VIEWS)}", "none")
    blocks: list[Block] = []
    for seed, path in product(range(5), folders):
        layout = path.parent.name
        starts = ["dense", "scene"] if layout == "blender" else ["dense"]  # Blender's random points, as published
        for views in VIEWS[layout]:
            if views <= _training_photos(path):
                methods = METHODS if layout == "llff" and views == 3 else MAIN
                blocks.append(([seed], [(str(path.relative_to(data)), views)], starts, methods))
    return blocks


def _by_seed(settings: Iterable[tuple[tuple[str, int], Iterable[str]]]) -> list[Block]:
    """Scenes with methods from dense points, all of a seed before the next."""
    return [([seed], [scene], ["dense"], methods) for seed, (scene, methods) in product(SEEDS, settings)]


def too_few_photos(preset: str, data: Path) -> list[str]:
    """The settings that the presets "field" and "paper" leave out for want of photos to train on, as sentences."""
    wanted: dict[Path, tuple[int, ...]] = {}
    if preset == "paper":
        wanted = {path: VIEWS[path.parent.name] for path in _scenes_of_paper(data)}
    elif preset == "field":
        wanted = {data / scene: counts for scene, counts in JOINED.items() if (data / scene).is_dir()}
    return [
        f"{path.relative_to(data)} with {n} views: it has {_training_photos(path)} photos to train on"
        for path, counts in wanted.items()
        for n in counts
        if n > _training_photos(path)
    ]


def _scenes_of_paper(data: Path) -> list[Path]:
    return [path for path in sorted(data.glob("*/*")) if path.is_dir() and path.parent.name in VIEWS]


@cache
def _training_photos(path: Path) -> int:
    """How many photos of a scene are not held out; for a scene that cannot be read so many that its cells say why."""
    try:
        return len(load_scene(path, photos=False).train)
    except DataError:
        return max(map(max, VIEWS.values()))
