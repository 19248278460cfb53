"""The first points of a fit where the depths are known: how wrong, how complete and how slow each kind of them is."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.scene import Views
from kgs.datasets.synthetic import synthetic_depths
from kgs.fit.outputs import versions, write_json
from kgs.fit.starts import FirstPoints, first_points

from .output import markdown_table, write_csv
from .scenes import check_scenes
from .start_measures import CLOSE, NEAR, complete_pixels, depth_errors, front_depths, model_errors, seen_twice
from .statistics import summarize

__all__ = ["measure_starts"]

ALL_POINTS, RANDOM_POINTS = 10**6, 10_000
QUICK, SMALL, LARGE = (126, 168), (189, 252), (378, 504)  # height, width
SEEDS, FEW = 3, 8  # more views than these are measured with one seed
SYNTHETIC = [("forward", views, SMALL) for views in (3, 6, 12, 24)] + [("orbit", views, SMALL) for views in (8, 12)]
SYNTHETIC += [("forward", views, LARGE) for views in (3, 12, 24)]
REAL = [("llff/fern", 3), ("llff/flower", 3), ("colmap/trex", 3), ("blender/lego", 8), ("nerfstudio/fox", 12)]
REAL += [("llff/flower", views) for views in (6, 9, 24)]
_MEASURES = ("median_error", "bias", "within_1", "within_2", "complete", "complete_twice", "seen_twice")
_OF_MODEL = ("model_pairs", "model_error", "model_within_2")


def measure_starts(out: Path, *, quick: bool = False, say: Callable[[str], None] = print) -> list[dict[str, Any]]:
    """Measure, and write starts.csv, starts.json, starts.md and starts.png.

    The synthetic scene has exact depths. Real scenes, in the folder of the environment variable KGS_DATA, have counts
    and times; three views are also compared with the points of a COLMAP model where there is one, which were refined
    with the test views too and are not exact. (Most of many views that such a point projects into do not observe it.)

    Args:
        out: folder for the results, made if it is not there.
        quick: one small scene of three views with one seed: some ten seconds instead of twenty minutes.
        say: where lines for the user go.

    Returns:
        One row a scene, count of views, size, seed and kind of points; what was not measured is None.

    Raises:
        DataError: KGS_DATA is set and one of the scenes is not there.
    """
    data = None if quick else os.environ.get("KGS_DATA")
    if data is not None:
        check_scenes(Path(data), [name for name, _ in REAL])
    else:
        say("the synthetic scene alone" + ("" if quick else ": KGS_DATA is not set"))
    out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for kind, count, size in [("forward", 3, QUICK)] if quick else SYNTHETIC:
        for seed in range(1 if quick or count > FEW or size == LARGE else SEEDS):
            say(f"{kind}, {count} views of {size[1]}x{size[0]}, seed {seed} ...")
            rows += _synthetic_rows(kind, count, size, seed, None if rows else out / "starts.png")
    for name, count in REAL if data is not None else ():
        say(f"{name}, {count} views ...")
        rows += _real_rows(Path(data or ""), name, count)
    threads = torch.get_num_threads()
    write_csv(out / "starts.csv", rows)
    write_json(out / "starts.json", {"rows": rows, "threads": threads, "versions": versions()})
    (out / "starts.md").write_text(table := _markdown(rows, threads), encoding="utf-8")
    say(table)
    return rows


def _find(views: Views, asked: str, seed: int) -> tuple[FirstPoints, dict[str, Any]]:
    """The points, all that there are (10 000 if random), and the columns about how they came."""
    count = ALL_POINTS if asked == "dense" else RANDOM_POINTS
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        wall, cpu = time.perf_counter(), time.process_time()
        found = first_points(views, asked, seed=seed, count=count)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if found.kind == "random":
        found = FirstPoints(found.points[:RANDOM_POINTS], found.colors[:RANDOM_POINTS], "random")
    fallback = "; ".join(str(warning.message) for warning in caught)
    seconds = {"wall_seconds": round(wall, 2), "cpu_seconds": round(cpu, 2)}
    return found, {"asked": asked, "came": found.kind, "fallback": fallback, "points": len(found.points), **seconds}


def _synthetic_rows(
    kind: str, count: int, size: tuple[int, int], seed: int, picture: Path | None
) -> list[dict[str, Any]]:
    views = synthetic_scene(kind, count, 0, size, seed).train
    truth = synthetic_depths(views.cameras, kind, seed)[:, 0]
    surface, twice = truth > 0, seen_twice(views, truth)
    rows = []
    for asked in ("dense", "sift") if size == LARGE else ("dense", "sift", "random"):
        found, row = _find(views, asked, seed)
        errors, complete = depth_errors(found.points, views, truth), complete_pixels(found.points, views, truth)
        shares = (errors.abs() <= NEAR, errors.abs() <= CLOSE, complete[surface], complete[twice], twice[surface])
        values = [errors.abs().median(), errors.median(), *(share.double().mean() for share in shares)]
        row |= dict(zip(_MEASURES, map(float, values), strict=True)) | dict.fromkeys(_OF_MODEL)
        rows.append({"scene": kind, "views": count, "width": size[1], "height": size[0], "seed": seed, **row})
        if picture is not None and asked == "dense":
            _plot(picture, views, truth, found.points)
    return rows


def _real_rows(data: Path, name: str, count: int) -> list[dict[str, Any]]:
    has_model = count <= 3 and name.startswith(("llff", "colmap"))
    scene = load_scene(data / name, count, points="model-points" if has_model else "none")
    height, width = scene.train.images.shape[-2:]
    rows = []
    for asked in ("dense", "sift"):
        found, row = _find(scene.train, asked, 0)
        row |= dict.fromkeys((*_MEASURES, *_OF_MODEL))
        if has_model:
            errors = model_errors(found.points, scene.points, scene.train).abs()
            row["model_pairs"] = len(errors)
            if len(errors):
                row |= {
                    "model_error": float(errors.median()),
                    "model_within_2": float((errors <= CLOSE).double().mean()),
                }
        rows.append({"scene": name, "views": count, "width": width, "height": height, "seed": 0, **row})
    return rows


def _markdown(rows: list[dict[str, Any]], threads: int) -> str:
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["views"], f"{row['width']}x{row['height']}", row["asked"]), []).append(row)

    def lines(with_: str, columns: dict[str, int]) -> list[list[object]]:
        """One line a group that has a measure; shares and errors in percent."""
        table: list[list[object]] = []
        for (scene, views, size, asked), of in groups.items():
            if of[0][with_] is None:
                continue
            came = ", ".join(dict.fromkeys(row["came"] for row in of))
            line: list[object] = [scene, views, size, asked if came == asked else f"{asked}: {came}", len(of)]
            for name, decimals in columns.items():
                factor = 100 if name in _MEASURES or name in _OF_MODEL[1:] else 1
                summary = summarize(factor * row[name] for row in of)
                line.append("" if summary is None else summary.text(decimals))
            table.append(line)
        return table

    head = ("views", "size", "start", "n", "points")
    errors, shares, seconds = dict.fromkeys(_MEASURES[:2], 2), dict.fromkeys(_MEASURES[2:], 1), ("wall s", "CPU s")
    titles = ("median error", "median signed", "within 1 %", "within 2 %", "complete", "of those seen twice")
    text = markdown_table(
        "Points, at most a million, against exact depths, in percent: relative depth errors, and the share of the "
        "pixels with a surface that have a point within 2 pixels and 2 % of the depth; mean (standard deviation over n "
        "seeds)",
        (*head, *titles, "pixels that two views see"),
        lines("complete", {"points": 0, **errors, **shares}),
        first="scene",
    )
    text += markdown_table(
        f"Seconds that the points take, threads of torch: {threads}; mean (standard deviation over n seeds)",
        (*head, *seconds),
        lines("points", {"points": 0, "wall_seconds": 1, "cpu_seconds": 1}),
        first="scene",
    )
    of_model = lines("model_error", {"points": 0, "model_pairs": 0, "model_error": 2, "model_within_2": 1})
    if of_model:
        text += markdown_table(
            "Points against those of the COLMAP model, in percent: relative depth errors where a view has both within "
            "1.5 pixels",
            (*head, "pairs", "median error", "within 2 %"),
            of_model,
            first="scene",
        )
    return text


def _plot(path: Path, views: Views, truth: Tensor, points: Tensor) -> None:
    """The middle view: photo, exact depth, depth of the dense points, and their relative error; white has none."""
    from matplotlib.figure import Figure

    view = len(views) // 2
    exact = torch.where(truth[view] > 0, truth[view], torch.nan)
    depths = front_depths(points, views, view)
    depths = torch.where(depths.isfinite(), depths, torch.nan)
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    (photo, first), (second, third) = figure.subplots(2, 2)
    photo.imshow(views.images[view].permute(1, 2, 0).numpy())
    limits = {"vmin": float(exact.nan_to_num(torch.inf).min()), "vmax": float(exact.nan_to_num(0.0).max())}
    errors = 100 * (depths / exact - 1)
    figure.colorbar(first.imshow(exact.numpy(), cmap="turbo_r", **limits), ax=first)
    figure.colorbar(second.imshow(depths.numpy(), cmap="turbo_r", **limits), ax=second)
    figure.colorbar(third.imshow(errors.numpy(), cmap="RdBu", vmin=-5, vmax=5), ax=third, extend="both")
    titles = ("photo", "exact depth", "depth of the dense points, the first in each pixel", "its relative error [%]")
    for axis, title in zip((photo, first, second, third), titles, strict=True):
        axis.set(title=title, xticks=[], yticks=[])
    figure.savefig(path, dpi=100)
