"""How often the gates of found cameras err: photos on arcs around the synthetic scene, whose cameras are known."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import torch
import tyro

from kgs._support.errors import DataError
from kgs.app.files.outputs import write_png
from kgs.app.sfm import pose_photos
from kgs.app.sfm.map import quiet_pycolmap
from kgs.bench.output import markdown_table
from kgs.datasets import load_scene
from kgs.datasets.synthetic import synthetic_views
from kgs.geometry import camera_centers, degrees_between
from kgs.study.grid import Cell, run_grid
from kgs.study.pairs import grouped

SPACINGS = tuple(round(0.6 * 1.275**i, 2) for i in range(20))  # degrees between neighbours, up to 61
EASY = 2.0, 20.0  # degrees between neighbours that overlap and differ
WRONG = 2.0, 0.1  # degrees in some pair, share of the focal length: more is wrong
SIZE, DISTANCE = (378, 504), 2.3  # of a photo in pixels, and of the cameras from the middle of the scene


def cameras(*, out: Path, quick: bool = False, processes: int | None = None, scheduler: str | None = None) -> int:
    """How often cameras are found, refused, or accepted although they are wrong (half an hour; can go on).

    For example:
      python measure.py --out cameras-quick --quick
      python measure.py --out cameras --processes 2

    Needs the extra sfm, too. Writes cameras.jsonl and cameras.md.

    Args:
        out: folder for the results; cells that its cameras.jsonl has are not repeated.
        quick: two cells, to see that it works.
        processes: cells at a time, one per core unless given.
        scheduler: address of a Dask scheduler whose workers run the cells instead.
    """
    with quiet_pycolmap():  # a missing package is told once, not for each cell
        pass
    cells: list[Cell] = [{"world": w, "photos": n, "spacing": d} for w, n, d in product((0, 1), (3, 6), SPACINGS)]
    cells = [{"world": 0, "photos": 3, "spacing": d} for d in (5.0, 60.0)] if quick else cells
    rows = run_grid(cells, arc_cell, out / "cameras.jsonl", scheduler=scheduler, processes=processes)
    if rows:
        print(write_arcs(rows, out))
    return int(len(rows) < len(cells))


def arc_cell(cell: Cell) -> dict[str, Any]:
    """Find the cameras of "photos", "spacing" degrees apart on an arc in a "world", and compare with the truth."""
    angles = np.radians(cell["spacing"] * (np.arange(cell["photos"]) - (cell["photos"] - 1) / 2))
    away = np.stack([np.sin(angles), np.full_like(angles, -0.25), -np.cos(angles)], axis=1)
    truth = synthetic_views(DISTANCE * away, "orbit", size=cell.get("size", SIZE), seed=cell["world"])
    with TemporaryDirectory(prefix="kgs-") as temporary:
        folder = Path(temporary) / "photos"
        folder.mkdir()
        for name, image in zip(truth.names, truth.images, strict=True):
            write_png(folder / f"{name}.png", image)
        try:
            report = pose_photos(folder, Path(temporary) / "out", say=lambda line: None)
        except DataError as error:
            return {"accepted": False, "why": str(error).partition("photos: ")[2].partition(". ")[0]}
        found = load_scene(Path(temporary) / "out", hold_out=0).train
    registered = [truth.names.index(Path(name).stem) for name in found.names]
    ours = found.cameras.extrinsics.double()
    given = truth.cameras.extrinsics.double()[registered]
    between = [(r[:, None] @ r[None].mT) for r in (ours[:, :3, :3], given[:, :3, :3])]
    scales = torch.pdist(camera_centers(ours)) / torch.pdist(camera_centers(given))
    focal = report["focal_px"] / float(truth.cameras.fx[0]) - 1
    errors = {
        "degrees": float(degrees_between(*between).max()),
        "distances": float((scales.max() - scales.min()) / scales.mean()),
    }
    return {"accepted": True, "registered": len(registered), "focal": focal, **errors}


def write_arcs(rows: Sequence[Mapping[str, Any]], out: Path) -> str:
    """Write cameras.md, which it returns: how many were right, wrong or refused, and the worst that was accepted."""
    frame = pd.DataFrame([row["cell"] | row["result"] for row in rows])
    lines = []
    for (photos,), cells in grouped(frame, "photos"):
        good = cells[cells.accepted.astype(bool)]
        wrong = good[(good.degrees > WRONG[0]) | (good.focal.abs() > WRONG[1])]
        easy = cells[cells.spacing.between(*EASY)]
        counts = [len(good) - len(wrong), len(wrong), len(cells) - len(good)]
        refused = f"{len(easy) - int(easy.accepted.sum())} of {len(easy)}"
        worst = [
            f"{good[name].abs().max():.{digits}f}" for name, digits in (("degrees", 2), ("focal", 3), ("distances", 4))
        ]
        lines.append([photos, *counts, refused, f"{good.spacing.min():g} to {good.spacing.max():g}", *worst])
    heads = ["accepted, right", "accepted, wrong", "refused", f"refused of {EASY[0]:g} to {EASY[1]:g} degrees"]
    heads += ["degrees apart, accepted", "worst rotation [deg]", "worst focal length", "worst distance"]
    title = f"Photos on arcs, neighbours {SPACINGS[0]:g} to {SPACINGS[-1]:g} degrees apart, {len(rows)} cells"
    text = markdown_table(title, heads, lines, first="photos")
    (out / "cameras.md").write_text(text, encoding="utf-8")
    return text


if __name__ == "__main__":
    raise SystemExit(tyro.cli(cameras) or 0)
