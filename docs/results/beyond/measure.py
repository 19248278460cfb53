"""Beyond the photos: what cameras see that lie farther out than those of the training views.

Of the synthetic room the truth is known everywhere: cameras 1, 2 and 3 times as far from the middle of the training
cameras as these, over the pixels whose surface a training view shows. Of real scenes the outermost photos are held out
and the most central ones are trained on. `python measure.py --out OUT`, in minutes; with SCENES of KGS_DATA the real
ones too, in half an hour.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product
from math import ceil, inf
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import pandas as pd
import torch
import tyro
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.bench.output import mean_sd
from kgs.bench.scenes import check_scenes
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.border import with_border
from kgs.datasets.scene import Scene, Views
from kgs.datasets.synthetic import synthetic_depths, views_beyond
from kgs.fit.run import choose_points
from kgs.geometry.rigs import camera_centers
from kgs.metrics.coverage import views_that_show
from kgs.metrics.evaluate import masked_psnr
from kgs.metrics.lpips import Lpips
from kgs.study.cells import fit_and_measure, fit_config, load_lpips
from kgs.study.grid import Cell, run_grid
from kgs.study.pairs import frame_of, grouped
from kgs.study.presets import AUTO, name_of
from kgs.study.texts import counts, document, table_of

ROOM, ROOM_VIEWS = "room", 3  # the synthetic scene and its training views
PHOTOS = {"llff/fern": 3, "colmap/trex": 3, "nerfstudio/fox": 12}  # the real scenes and theirs
OUT = (1, 2, 3)  # distances from the middle of the training cameras, over theirs
SIZE = (189, 252)  # pixels of the room's views, height and width
CAMERAS = 6  # at each of these distances
OUTER = 0.25  # share of a real scene's photos that are held out
_NOTES = (
    "Mean (sd) over n seeds; PSNR in dB; LPIPS with VGG16, inputs in [0, 1]; seconds of wall time of a fit.",
    f"Synthetic: {CAMERAS} cameras on an ellipse around the middle of the training cameras, 1, 2 and 3 times as far "
    "out as these; all look at the middle of the scene. A pixel counts if a training view shows its surface: the point "
    "at its exact depth lies in that image, no farther than 1.05 times the exact depth of the nearest pixel there. For "
    "LPIPS the other pixels are the truth's. Share: of the pixels that count, at 1, 2 and 3. Inside: the test views, "
    "all pixels.",
    "Real: views are ordered by the distance of the camera's centre from the mean of all centres; the first ones are "
    f"trained on, the last {OUTER:.0%} of all photos are the outer views, all pixels. Seen: PSNR where, by the fit's "
    "own depth, two training views show the surface, and the share of these pixels.",
)
# What a table has of a scene: the columns of PSNR, or of a share, and of LPIPS.
_TEST = ("test.psnr", "test.lpips_vgg_unscaled")
_SYNTHETIC = {"inside": _TEST} | {f"{out} times out": (f"beyond.{out}.psnr", f"beyond.{out}.lpips") for out in OUT}
_REAL = {
    "outer views": _TEST,
    "seen": ("seen.psnr", None),
    "share": ("seen.share", None),
    "training views": ("train.psnr", "train.lpips_vgg_unscaled"),
}
_SHARES = [f"beyond.{out}.share" for out in OUT]
_NUMBERS = [column for columns in (*_SYNTHETIC.values(), *_REAL.values()) for column in columns if column is not None]
_NUMBERS = [*dict.fromkeys(_NUMBERS), *_SHARES, "gaussians", "wall_seconds"]


class Target(NamedTuple):
    """Views from beyond the photos, and the pixels of each that count, bool `(H, W)`."""

    views: Views
    shown: Sequence[Tensor]


def beyond_cells(data: Path | None) -> list[Cell]:
    """The cells: three seeds of the room, then, with a folder `data`, of the real ones."""
    if data is not None:
        check_scenes(data, PHOTOS)
    parts = [({ROOM: ROOM_VIEWS}, None, 500), ({} if data is None else PHOTOS, 2.0, 1000)]
    return [
        {"scene": scene, "views": views, "downscale": downscale, "method": AUTO, "seed": seed}
        | {"fit": {"preset": AUTO, "steps": steps, "sh_degree": 0}}
        for scenes, downscale, steps in parts
        for seed, (scene, views) in product(range(3), scenes.items())
    ]


def beyond_cell(cell: Cell, data: str | None = None, lpips_weights: str | None = None) -> dict[str, Any]:
    """Fit once, and measure test views and, of the room, the views beyond the photos.

    Args:
        cell: "scene" (`ROOM`, or a folder below `data`), "views", "downscale", "method" (a name, for the report),
            "seed", and "fit": the fields of FitConfig that are not those of the default.
        data: the folder of the real scenes.
        lpips_weights: a folder with the weights of VGG16 and LPIPS, or None to leave LPIPS out.

    Returns:
        What every cell stores of a fit; "test" and "train": the means of `evaluate`; "beyond": by distance, as text,
        what `measure_target` returns; of real scenes, whose test views are the outer ones, it is empty.
    """
    config, _ = fit_config("dense", cell["seed"], cell["fit"])
    scene = _scene(cell["scene"], cell["views"], cell["downscale"], data)
    points = choose_points(scene, config)
    lpips = load_lpips(lpips_weights)
    _, fit, stored = fit_and_measure(scene, config, points, lpips, name=name_of(cell))
    targets = room_targets(scene) if cell["scene"] == ROOM else {}
    stored["beyond"] = {str(out): measure_target(fit.render, target, lpips) for out, target in targets.items()}
    return stored


def room_targets(scene: Scene) -> dict[int, Target]:
    """For each distance of `OUT` the views of the room from there, and the pixels that count.

    A pixel counts if at least one training view shows its surface: by exact depths, see `views_that_show`.
    """
    train = scene.train
    height, width = train.images.shape[-2:]
    train_depths = list(synthetic_depths(train.cameras)[:, 0])
    targets = {}
    for out in OUT:
        views = views_beyond(out, CAMERAS, (height, width))
        depths = enumerate(synthetic_depths(views.cameras)[:, 0])
        counts = [views_that_show(depth, views.camera(i), train_depths, train.cameras) for i, depth in depths]
        targets[out] = Target(views, [count > 0 for count in counts])
    return targets


@torch.no_grad()
def measure_target(
    render: Callable[[PinholeCamera], Tensor], target: Target, lpips: Lpips | None = None
) -> dict[str, float | None]:
    """Compare renders `(1, 3, H, W)` with views over the pixels that count.

    Returns:
        "share" of the pixels that count; "psnr" of these in dB, and "lpips" (inputs in [0, 1]) of renders whose other
        pixels are the truth's; means over the views with such pixels, None without any or without the network, "psnr"
        also if one is infinite.
    """
    shares, levels, distances = list[float](), list[float](), list[float]()
    for i, shown in enumerate(target.shown):
        truth = target.views.images[i]
        drawn = target.views.as_photo(i, target.views.render(i, render)[0].cpu())
        image = torch.where(shown, drawn, truth)
        share = float(shown.float().mean())
        shares.append(share)
        if share == 0:
            continue
        levels.append(masked_psnr(image, truth, share))
        if lpips is not None:
            distances.append(float(lpips(image[None], truth[None], False)))
    psnr = fmean(levels) if levels else inf
    return {
        "share": round(fmean(shares), 4),
        "psnr": round(psnr, 4) if psnr < inf else None,
        "lpips": round(fmean(distances), 5) if distances else None,
    }


def from_the_middle(scene: Scene, count: int) -> Scene:
    """A scene without test views, split again: the `count` most central views to train on, the outermost ones to test.

    The middle is the mean of all camera centres; views are ordered by the distance of their centre from it. The last
    `OUTER` of them, rounded up, are test views; what lies between the two groups is left out.
    """
    views = scene.train
    centers = camera_centers(views.cameras.extrinsics).double()
    order = (centers - centers.mean(dim=0)).norm(dim=1).argsort(stable=True).tolist()
    held_out = min(ceil(OUTER * len(order)), len(order) - count)
    middle = sorted(order[:count])
    train = with_border(views.select(middle))  # that of all photos would depend on those held out
    test = replace(views.select(sorted(order[len(order) - held_out :])), border_mask=train.border_mask)
    full_size = None if scene.train_full_size is None else with_border(scene.train_full_size.select(middle))
    return replace(scene, train=train, test=test, train_full_size=full_size)


@lru_cache(maxsize=1)
def _scene(name: str, views: int, downscale: float | None, data: str | None) -> Scene:
    if name == ROOM:
        return synthetic_scene(views, CAMERAS, SIZE)
    return from_the_middle(load_scene(Path(data or "") / name, downscale=downscale, hold_out=0), views)


def write_beyond(rows: Sequence[Mapping[str, Any]], out: Path) -> str:
    """Write beyond.md, and return what it holds."""
    frame = frame_of(rows, _NUMBERS).astype(dict.fromkeys(_NUMBERS, float))
    commits = counts(row["result"].get("revision") or "of no known commit" for row in rows)
    is_room = frame.scene == ROOM
    tables = {"Synthetic scene": _table(frame[is_room], _SYNTHETIC), "Real scenes": _table(frame[~is_room], _REAL)}
    shown = {title: table for title, table in tables.items() if len(table)}
    text = document("Beyond the photos", [f"{len(rows)} cells; by commit of kgs: {commits}.", *_NOTES], shown)
    (out / "beyond.md").write_text(text.rstrip() + "\n", encoding="utf-8")
    return text


def _table(frame: pd.DataFrame, heads: Mapping[str, tuple[str, str | None]]) -> pd.DataFrame:
    """A line of text for each scene, number of views and method."""
    lines = []
    for (scene, views, method), cells in grouped(frame, "scene", "views", "method"):
        line = {"scene": f"{scene}, {views} views", "method": method, "n": str(len(cells))}
        for head, (psnr, lpips) in heads.items():
            line[head] = mean_sd(cells[psnr], 2)
            if lpips is not None and cells[lpips].count():
                line[head] += f"; {mean_sd(cells[lpips], 3)}"
        if scene == ROOM:
            line["share"] = ", ".join(f"{share:.2f}" for share in cells[_SHARES].iloc[0])
        line["Gaussians"] = mean_sd(cells.gaussians, 0)
        line["seconds"] = mean_sd(cells.wall_seconds, 0)
        lines.append(line)
    return table_of(lines)


def main(*, out: Path, lpips_weights: Path | None = None, processes: int | None = None) -> int:
    """Fit and measure what beyond.jsonl does not have yet, and write beyond.md.

    Args:
        out: folder for the results.
        lpips_weights: folder with VGG16 and LPIPS weights; without it LPIPS is left out.
        processes: fits at a time, one per core unless given.
    """
    data = os.environ.get("KGS_DATA")
    cells = beyond_cells(None if data is None else Path(data))
    work = partial(
        beyond_cell, data=data, lpips_weights=None if lpips_weights is None else str(lpips_weights.resolve())
    )
    rows = run_grid(cells, work, out / "beyond.jsonl", processes=processes, name=name_of)
    if rows:
        print(write_beyond(rows, out))
    return int(len(rows) < len(cells))


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
