"""Cameras of real photos, in sets of six and in whole folders: how many are registered, and how far off they are."""

import os
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from kgs._support.errors import DataError
from kgs.app.sfm import pose_photos
from kgs.app.sfm.find import find_photos
from kgs.bench.output import markdown_table
from kgs.datasets import load_scene
from kgs.study.grid import Cell, run_grid

FOLDERS = {  # by the name of a set: where its photos are in SCENES, and where their given poses
    "headphones": ("photos/headphones", ""),
    "monstree": ("photos/monstree", "colmap/monstree"),
    "banana": ("photos/banana", ""),
    "fox": ("nerfstudio/fox/images", "nerfstudio/fox"),
}
FEW = 6  # photos of a part of a folder
HEADS = "registered", "degrees off", "pixels"
Rotations = dict[str, NDArray[np.float64]]  # by the stems of the photos' names


def cameras(*, out: Path, processes: int | None = None) -> int:
    """How many real photos are registered, and how far their cameras are from the given ones (20 minutes; can go on).

    For example:
      KGS_DATA=SCENES python real.py --out cameras --processes 1

    Needs the extra sfm, too. Writes sets.jsonl and sets.md. "Degrees off" is the worst rotation of a pair against given
    poses, or, for parts of a folder without them, against those that were found of all its photos together.

    Args:
        out: folder for the results; sets that its sets.jsonl has are not repeated.
        processes: sets at a time, one per core unless given.
    """
    cells: list[Cell] = [
        {"folder": folder, "first": 0, "step": 1, "photos": 0} for folder in FOLDERS if folder != "fox"
    ]
    cells += [{"folder": "banana", "first": first, "step": 1, "photos": FEW} for first in range(11)]
    cells += [{"folder": "fox", "first": first, "step": 1, "photos": FEW} for first in range(0, 45, 4)]
    for step in (2, 3, 5, 8):
        starts = range(0, 50 - 5 * step, 5)
        cells += [{"folder": "fox", "first": first, "step": step, "photos": FEW} for first in starts]
    rows = run_grid(cells, set_cell, out / "sets.jsonl", processes=processes)
    if rows:
        print(write_sets(rows, out))
    return int(len(rows) < len(cells))


def set_cell(cell: Cell) -> dict[str, Any]:
    """Find the cameras of every "step"-th photo of a folder from the "first" on, all of them if "photos" is 0."""
    paths = find_photos(_scenes() / FOLDERS[cell["folder"]][0])[cell["first"] :: cell["step"]]
    with TemporaryDirectory(prefix="kgs-") as temporary:
        folder = Path(temporary) / "photos"
        folder.mkdir()
        for path in paths[: cell["photos"] or None]:
            (folder / path.name).symlink_to(path.resolve())
        given = len(list(folder.iterdir()))
        try:
            report = pose_photos(folder, Path(temporary) / "out", say=lambda line: None)
        except DataError as error:
            return {"given": given, "rotations": {}, "why": error.advice.partition("\n")[0]}
        views = load_scene(Path(temporary) / "out", hold_out=0).train
    turns = {name: cv2.Rodrigues(pose[:3, :3].numpy())[0].ravel() for name, pose in _poses(views)}
    return {
        "given": given,
        "rotations": {name: turn.round(6).tolist() for name, turn in turns.items()},
        "points": report["points"],
        "pixels": report["reprojection_error_px"],
        "apart": report["agreement_degrees"],
        "seconds": sum(report["seconds"].values()),
    }


def write_sets(rows: Sequence[Mapping[str, Any]], out: Path) -> str:
    """Write sets.md, which it returns: a row for each set."""
    known = {folder: _known(folder, rows) for folder in FOLDERS}
    lines = []
    for row in rows:
        cell, result = row["cell"], row["result"]
        last = cell["first"] + cell["step"] * (result["given"] - 1)
        name = f"{cell['folder']} {cell['first']}-{last}" + (f" by {cell['step']}" if cell["step"] > 1 else "")
        is_measure = not cell["photos"] and not FOLDERS[cell["folder"]][1]
        lines.append([name, result["given"], *_columns(result, {} if is_measure else known[cell["folder"]])])
    text = markdown_table("Cameras of real photos", ("photos", *HEADS), lines, first="set")
    (out / "sets.md").write_text(text, encoding="utf-8")
    return text


def _columns(result: Mapping[str, Any], known: Rotations) -> list[str]:
    found = {name: cv2.Rodrigues(np.array(turn))[0] for name, turn in result["rotations"].items()}
    pairs = [pair for pair in combinations(found, 2) if set(pair) <= known.keys()]
    off = [_angle(found[b] @ found[a].T, known[b] @ known[a].T) for a, b in pairs]
    return [str(len(found)), f"{max(off):.2f}" if off else "", f"{result['pixels']:.2f}" if found else ""]


def _known(folder: str, rows: Sequence[Mapping[str, Any]]) -> Rotations:
    """The rotations of a folder's given poses, else those that were found of all its photos together."""
    if scene := FOLDERS[folder][1]:
        poses = _poses(load_scene(_scenes() / scene, hold_out=0).train)
        return {name: pose[:3, :3].double().numpy() for name, pose in poses}
    whole = next((row["result"] for row in rows if row["cell"]["folder"] == folder and not row["cell"]["photos"]), {})
    return {name: cv2.Rodrigues(np.array(turn))[0] for name, turn in whole.get("rotations", {}).items()}


def _poses(views: Any) -> list[tuple[str, Any]]:
    """World-to-camera poses by the stems of the photos' names."""
    return [(Path(name).stem, pose) for name, pose in zip(views.names, views.cameras.extrinsics, strict=True)]


def _angle(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(one @ other.T)[0])))


def _scenes() -> Path:
    return Path(os.environ["KGS_DATA"])


if __name__ == "__main__":
    raise SystemExit(tyro.cli(cameras) or 0)
