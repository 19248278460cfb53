"""The initial points of a fit where the depths are known: how wrong, how complete and how slow each kind of them is."""

import os
import time
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from kgs.bench.output import Row, markdown_table, mean_sd, write_results
from kgs.bench.scenes import check_scenes
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.scene import Views
from kgs.datasets.synthetic import synthetic_depths
from kgs.geometry.cameras import project
from kgs.geometry.rigs import camera_centers
from kgs.init_points import initial_points

ALL_POINTS, RANDOM_POINTS = 10**6, 10_000
QUICK, SMALL, LARGE = (126, 168), (189, 252), (378, 504)  # height, width
SEEDS, FEW = 3, 8  # more views than these are measured with one seed
ROOM = [(views, SMALL) for views in (3, 6, 12, 24)] + [(views, LARGE) for views in (3, 12, 24)]
REAL = [("llff/fern", 3), ("llff/flower", 3), ("colmap/trex", 3), ("blender/lego", 8), ("nerfstudio/fox", 12)]
REAL += [("llff/flower", views) for views in (6, 9, 24)]
NEAR, CLOSE = 0.01, 0.02  # relative depth errors that are counted
HIDDEN = 0.05  # a point so much farther than the surface before it is hidden there, not wrong
REACH = 2  # pixels, from a point to those it completes
EDGE = 1.05  # ratio of depths of neighbouring pixels above which nothing is interpolated between them
# Columns of the tables: head, decimals, factor.
_MEASURES = {"median_error": ("median error", 2, 100), "bias": ("median signed", 2, 100)}
_MEASURES |= {"within_1": ("within 1 %", 1, 100), "within_2": ("within 2 %", 1, 100), "complete": ("complete", 1, 100)}
_SECONDS = {"wall_seconds": ("wall s", 1, 1), "cpu_seconds": ("CPU s", 1, 1)}


def starts(*, out: Path, quick: bool = False) -> None:
    """Depth errors, completeness and times of the initial points of a fit.

    For example:
      python measure.py --out starts --quick
      KGS_DATA=SCENES python measure.py --out starts

    Writes starts.csv, starts.json and starts.md in 20 minutes, with --quick in 10 seconds. The synthetic scene has
    exact depths. Real scenes, all in the folder of the environment variable KGS_DATA, have counts and times.

    Args:
        out: folder for the results, made if it is not there.
        quick: one small synthetic scene of three views with one seed.
    """
    if (data := None if quick else os.environ.get("KGS_DATA")) is not None:
        check_scenes(Path(data), [name for name, _ in REAL])
    else:
        print("the synthetic scene alone" + ("" if quick else ": KGS_DATA is not set"))
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for count, size in [(3, QUICK)] if quick else ROOM:
        for seed in range(1 if quick or count > FEW or size == LARGE else SEEDS):
            print(f"room, {count} views of {size[1]}x{size[0]}, seed {seed} ...")
            views = synthetic_scene(count, 0, size, seed).train
            rows += _rows("room", views, seed, synthetic_depths(views.cameras, seed)[:, 0])
    for name, count in REAL if data is not None else ():
        print(f"{name}, {count} views ...")
        rows += _rows(name, load_scene(Path(data or "") / name, count).train)
    write_results(out / "starts", rows, _markdown(rows))


def _rows(scene: str, views: Views, seed: int = 0, truth: Tensor | None = None) -> list[Row]:
    """One per kind of start; `truth`: the exact depths, where they are known."""
    height, width = views.images.shape[-2:]
    about, rows = {"scene": scene, "views": len(views), "width": width, "height": height, "seed": seed}, []
    for asked in ("dense", "sift") if truth is None or (height, width) == LARGE else ("dense", "sift", "random"):
        points, row = _find(views, asked, seed)
        row |= dict.fromkeys(_MEASURES)
        if truth is not None:
            errors, complete = depth_errors(points, views, truth), complete_pixels(points, views, truth)
            shares = (errors.abs() <= NEAR, errors.abs() <= CLOSE, complete[truth > 0])
            values = (errors.abs().median(), errors.median(), *(share.double().mean() for share in shares))
            row |= dict(zip(_MEASURES, map(float, values), strict=True))
        rows.append(about | row)
    return rows


def _find(views: Views, asked: str, seed: int) -> tuple[Tensor, Row]:
    """The points, at most a million (10 000 if random), and the columns about how they came."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        wall, cpu = time.perf_counter(), time.process_time()
        found = initial_points(views, asked, seed=seed, count=ALL_POINTS if asked == "dense" else RANDOM_POINTS)
        seconds = {"wall_seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
    points = found.points[:RANDOM_POINTS] if found.kind == "random" else found.points
    fallback = "; ".join(str(warning.message) for warning in caught)
    row = {"asked": asked, "came": found.kind, "fallback": fallback, "points": len(points)}
    return points, row | {name: round(value, 2) for name, value in seconds.items()}


def _markdown(rows: list[Row]) -> str:
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["views"], f"{row['width']}x{row['height']}", row["asked"]), []).append(row)

    def table(title: str, columns: dict[str, tuple[str, int, int]]) -> str:
        """One line per group that has these measures."""
        columns, lines = {"points": ("points", 0, 1), **columns}, []
        for (*about, asked), of in groups.items():
            if None not in (of[0][name] for name in columns):
                came = ", ".join(dict.fromkeys(row["came"] for row in of))
                values = (mean_sd((f * row[name] for row in of), d) for name, (_, d, f) in columns.items())
                lines.append([*about, asked if came == asked else f"{asked}: {came}", len(of), *values])
        heads = ("views", "size", "start", "n", *(head for head, _, _ in columns.values()))
        return markdown_table(f"{title}; mean (standard deviation over n seeds)", heads, lines, first="scene")

    errors = "Relative depth errors and complete pixels (a point within 2 pixels and 2 % of the depth), in percent"
    return table(errors, _MEASURES) + table(f"Seconds with {torch.get_num_threads()} threads of torch", _SECONDS)


def depth_errors(points: Tensor, views: Views, truth: Tensor) -> Tensor:
    """Depth over the surface's depth less 1, `(P,)` float64, in the view of the nearest camera that sees the point.

    Points are `(P, 3)`; `truth` holds exact depths along z `(V, H, W)` in float64, 0 without a surface (error -1).
    The inverse depth, linear on a plane, is interpolated between pixels; at an edge (neighbours over 5 % apart) it is
    that of the pixel the point falls into. A point is hidden where it is more than 5 % behind the surface; one that is
    hidden in all views is judged in the nearest; the error is infinite where no view has the point in its image.
    """
    errors = torch.stack([_view_errors(points, views, truth, view) for view in range(len(views))], 1)
    inside = ~errors.isnan()
    seen = inside & (errors <= HIDDEN)
    usable = torch.where(seen.any(1, keepdim=True), seen, inside)
    distances = torch.cdist(points.double(), camera_centers(views.cameras.extrinsics)).masked_fill(~usable, torch.inf)
    return torch.where(inside.any(1), errors.gather(1, distances.argmin(1, keepdim=True))[:, 0], torch.inf)


def complete_pixels(points: Tensor, views: Views, truth: Tensor) -> Tensor:
    """Which pixels have a point within 2 pixels and 2 % of their exact depth, `(V, H, W)`; see `depth_errors`."""
    found = torch.zeros_like(truth, dtype=torch.bool)
    limits = torch.tensor([truth.shape[2], truth.shape[1]])
    for view, exact in enumerate(truth):
        pixels, depths = (part[:, 0] for part in project(views.camera(view), points))
        for offset in product(range(-REACH, REACH + 1), repeat=2):
            near = pixels.round() + torch.tensor(offset)
            inside = ((near >= 0) & (near < limits)).all(1) & ((near - pixels).norm(dim=1) <= REACH)
            x, y = near[inside].long().unbind(1)
            close = (depths[inside] / exact[y, x] - 1).abs() <= CLOSE
            found[view, y[close], x[close]] = True
    return found


def _view_errors(points: Tensor, views: Views, truth: Tensor, view: int) -> Tensor:
    """Depth over the surface's depth less 1 in one view, `(P,)`; NaN where the point is not in its image."""
    pixels, depths = (part[:, 0] for part in project(views.camera(view), points))
    inverse = torch.where(truth[view] > 0, 1 / truth[view], 0.0)
    height, width = inverse.shape
    limits = torch.tensor([width, height]) - 0.5
    inside = (depths > 0) & ((pixels > -0.5) & (pixels < limits)).all(1)
    x, y = torch.where(inside[:, None], pixels, 0.0).clamp(torch.zeros(2), limits - 0.5).unbind(1)
    left, top = x.floor().long().clamp(max=width - 2), y.floor().long().clamp(max=height - 2)
    right, below = x - left, y - top
    corners = torch.stack([inverse[top + i, left + j] for i in (0, 1) for j in (0, 1)])
    weights = torch.stack([a * b for a in (1 - below, below) for b in (1 - right, right)])
    own = corners.gather(0, weights.argmax(0, keepdim=True))[0]
    smooth = corners.amax(0) <= EDGE * corners.amin(0)
    return torch.where(inside, depths * torch.where(smooth, (weights * corners).sum(0), own) - 1, torch.nan)


if __name__ == "__main__":
    raise SystemExit(tyro.cli(starts) or 0)
