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

from .cells import FULL
from .grid import Cell

OFF = "off"
PAPER = "progressive 0.2"
FIXED = "fixed 0.1"
MAIN = (OFF, PAPER, FIXED)
AUTO = "auto"  # kgs fit as it comes
AUTO_OFF = "auto, off"  # the same without dropping
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
    "field-long": {"steps": 10_000},
    "paper": {"steps": 10_000},
    "guard": {"steps": 700},
}
Block = tuple[Iterable[int], Iterable[tuple[str, int]], Iterable[str], Iterable[str]]  # seeds, scenes, starts, methods


def sparse_cells(preset: str, data: Path | None) -> list[Cell]:
    """The cells of a preset, the most telling ones first, those of one start together.

    Args:
        preset: "quick": the synthetic scene, minutes. "cpu": the six scenes of `SCENES` in a quarter of the pixels of
            504x378, 2000 steps, and the synthetic one to be shown; hours. "field": the six scenes in full size, 2000
            steps, the default with its own number, more views, and what is there of `JOINED`; hours. "field-long": the
            first three of them with 10 000 steps; hours. "paper": 10 000 steps in full size on every scene below
            `data`; days on a CPU. "guard": the eight scenes of `GUARD` in half size, the default with its own number of
            steps and the paper's rule with 700, seed 0, then the default with seeds 1 and 2; minutes.
        data: the folder of the scenes: `llff/fern` and so on; DataError: None, or a scene is missing.
    """
    if preset not in _FITS:
        raise ArgumentError("preset", f"one of {list(_FITS)}", quoted(preset))
    if preset == "quick":
        scene = [(SYNTHETIC, 3)]
        blocks: list[Block] = [
            (range(3), scene, ["dense"], MAIN),
            ([0], scene, ["dense"], ("fixed 0.2", "far", "L1 distance 0.01")),
            ([0], scene, ["dense"], (AUTO, AUTO_OFF)),
            ([0], scene, ["sift", "random"], [PAPER]),
        ]
    elif data is None:
        raise DataError(Path("KGS_DATA"), "", f"this environment variable for the preset {preset!r}", "none")
    else:
        blocks_of = {"cpu": _cpu, "field": _field, "field-long": _field_long, "paper": _paper, "guard": _guard}
        blocks = blocks_of[preset](data)
    fits = {method: _FITS[preset] | settings for method, settings in METHODS.items()}
    if preset in ("field", "guard"):
        for method in (AUTO, AUTO_OFF):
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
    seeds = range(3)
    fern = [("llff/fern", 3)]
    flower = [("llff/flower", 3)]
    lego = [("blender/lego", 8)]
    auto = (AUTO, AUTO_OFF)
    rivals = [name for name in METHODS if name not in (*MAIN, *auto)]
    bounds = ("random", "model-points", FULL)  # no fit may have the last two
    blocks: list[Block] = []
    for seed in seeds:
        for methods in (MAIN, auto):
            blocks += [([seed], [scene], ["dense"], methods) for scene in SCENES.items()]
    for seed in seeds:
        blocks += [([seed], MORE_VIEWS, ["dense"], methods) for methods in ((OFF, PAPER), auto)]
    blocks += [([seed], SCENES.items(), ["sift"], [PAPER]) for seed in seeds]
    blocks.append((seeds, lego, ["scene"], MAIN))
    blocks.append((seeds, fern, ["dense"], rivals))
    blocks += [(seeds, fern, [start], [PAPER]) for start in bounds]
    blocks += [([0], [(SYNTHETIC, 3)], ["dense"], methods) for methods in (MAIN, auto)]  # pictures for the page
    blocks.append(([0], flower, bounds, [PAPER]))
    return blocks


def _field(data: Path) -> list[Block]:
    """The field's protocol: photos in the size that they have, every eighth held out. LLFF's are 504x378."""
    check_scenes(data, SCENES)
    seeds = range(3)
    auto = (AUTO, AUTO_OFF)
    blocks: list[Block] = []
    for scenes in (FORWARD, OBJECTS):
        for seed in seeds:
            blocks += [([seed], [scene], ["dense"], MAIN) for scene in scenes.items()]
    for seed in seeds:
        blocks += [([seed], [scene], ["dense"], auto) for scene in SCENES.items()]
    for seed in seeds:
        for setting in (*product(FORWARD, (6, 9)), *_joined(data)):
            blocks += [([seed], [setting], ["dense"], methods) for methods in ((OFF, PAPER), auto)]
    return blocks


def _joined(data: Path) -> list[tuple[str, int]]:
    return [
        (scene, views)
        for scene, counts in JOINED.items()
        for views in counts
        if (data / scene).is_dir() and views <= _training_photos(data / scene)
    ]


def _field_long(data: Path) -> list[Block]:
    check_scenes(data, FORWARD)
    return [([seed], [scene], ["dense"], (OFF, PAPER, AUTO)) for seed in range(3) for scene in FORWARD.items()]


def _guard(data: Path) -> list[Block]:
    """Three methods with one seed; last the default's other seeds, which tell the noise of each scene."""
    check_scenes(data, GUARD)
    blocks: list[Block] = [([0], [scene], ["dense"], (AUTO, AUTO_OFF, PAPER)) for scene in GUARD.items()]
    blocks.append(((1, 2), GUARD.items(), ["dense"], [AUTO]))
    return blocks


def too_few_photos(preset: str, data: Path) -> list[str]:
    """The settings that the presets "field" and "paper" leave out for want of photos to train on, as sentences."""
    wanted: dict[Path, tuple[int, ...]] = {}
    if preset == "paper":
        wanted = {path: VIEWS[path.parent.name] for path in _scenes_of_paper(data)}
    elif preset == "field":
        wanted = {data / scene: counts for scene, counts in JOINED.items() if (data / scene).is_dir()}
    sentences = []
    for path, counts in wanted.items():
        there = _training_photos(path)
        name = path.relative_to(data)
        sentences += [f"{name} with {n} views: it has {there} photos to train on" for n in counts if n > there]
    return sentences


def _scenes_of_paper(data: Path) -> list[Path]:
    return [path for path in sorted(data.glob("*/*")) if path.is_dir() and path.parent.name in VIEWS]


@cache
def _training_photos(path: Path) -> int:
    """How many photos of a scene are not held out; for a scene that cannot be read so many that its cells say why."""
    try:
        return len(load_scene(path, photos=False).train)
    except DataError:
        return max(map(max, VIEWS.values()))


def _paper(data: Path) -> list[Block]:
    folders = _scenes_of_paper(data)
    if not folders:
        raise DataError(data, "", f"scenes in folders named {sorted(VIEWS)}", "none")
    blocks: list[Block] = []
    for seed in range(5):
        for path in folders:
            layout = path.parent.name
            # Blender scenes also from the layout's random points, as published.
            starts = ["dense", "scene"] if layout == "blender" else ["dense"]
            for views in VIEWS[layout]:
                if views > _training_photos(path):
                    continue  # `too_few_photos` names it
                methods = METHODS if layout == "llff" and views == 3 else MAIN
                blocks.append(([seed], [(str(path.relative_to(data)), views)], starts, methods))
    return blocks
