"""Where test pixels lose: what training photos see of them, and what the depths of the initial points say there."""

import os
from pathlib import Path

import torch
import tyro
from kornia.geometry.camera import PinholeCamera
from measure import confirmed_depths, depth_range
from torch import Tensor

from kgs.bench.output import Row, markdown_table, write_results
from kgs.bench.scenes import check_scenes
from kgs.datasets import load_scene
from kgs.fit.config import FitConfig
from kgs.fit.run import fit_scene
from kgs.geometry.cameras import project, to
from kgs.geometry.multiview import nearest_pixels, unproject
from kgs.init_points.agreement import consistent_pixels
from kgs.init_points.dense import agreed_depths

SCENES = ("llff/fern", "llff/flower", "colmap/trex", "colmap/fortress")
VIEWS = 3
DOWNSCALE = 2.0
RIGHT = 0.02  # of the depth, by which an agreed depth may be off
KINDS = ("depth unknown", "no photo", "one photo", "two: nothing agreed", "two: agreed, wrong", "two: agreed, right")


def lost(*, out: Path, seed: int = 0) -> None:
    """Divide the test pixels of four scenes by what the training photos see of them; each kind's PSNR and share.

    For example:
      KGS_DATA=SCENES python lost.py --out depth

    Depths of test pixels are those that a sweep through all photos finds and two others confirm; a fit may not use
    them. A training photo sees a pixel if its point lies in the photo and no such depth there is nearer.

    Args:
        out: folder for lost.csv, lost.json and lost.md, made if it is not there.
        seed: of the fits.
    """
    data = Path(os.environ["KGS_DATA"])
    check_scenes(data, SCENES)
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for name in SCENES:
        print(f"{name} ...")
        rows += _rows(data, name, seed)
    heads = ["pixels, %", "squared error, %", "PSNR"]
    lines = [[row["scene"], row["kind"], *(f"{row[head]:.1f}" for head in heads)] for row in rows]
    title = "Test pixels by what the training photos see of them"
    write_results(out / "lost", rows, markdown_table(title, ["kind", *heads], lines, first="scene"))


def _rows(data: Path, name: str, seed: int) -> list[Row]:
    scene = load_scene(data / name, VIEWS, DOWNSCALE)
    everything = load_scene(data / name, None, DOWNSCALE, hold_out=0).train
    cameras = to(scene.train.cameras, "cpu", torch.float64)
    near, far = depth_range(scene.train)
    maps, certain = agreed_depths(scene.train, near, far)
    of_points = [
        torch.where(consistent_pixels(cameras, maps, certain, view), maps[view].depths, 0.0) for view in range(VIEWS)
    ]
    true = confirmed_depths(everything, near, far, list(range(len(everything))))
    of_name = dict(zip(everything.names, true, strict=True))
    of_photos = [of_name[photo] for photo in scene.train.names]
    kinds = torch.stack(
        [
            _kinds(scene.test.cameras, view, of_name[photo], cameras, of_points, of_photos)
            for view, photo in enumerate(scene.test.names)
        ]
    )
    fit = fit_scene(scene, FitConfig(seed=seed))
    renders = torch.stack([fit.render(scene.test.camera(view))[0] for view in range(len(scene.test))])
    errors = (renders.clamp(0, 1) - scene.test.images).square().mean(1)
    rows: list[Row] = []
    for number, kind in enumerate(KINDS):
        chosen = errors[kinds == number]
        psnr = -10 * float(chosen.mean().log10())
        share = 100 * float((kinds == number).double().mean())
        error = 100 * float(chosen.sum() / errors.sum())
        rows.append({"scene": name, "kind": kind, "pixels, %": share, "squared error, %": error, "PSNR": psnr})
    return rows


def _kinds(
    cameras: PinholeCamera,
    view: int,
    depths: Tensor,
    training: PinholeCamera,
    of_points: list[Tensor],
    true: list[Tensor],
) -> Tensor:
    """The number in `KINDS` of each pixel of a test view, `(H, W)`.

    Args:
        cameras: of the test views.
        view: the test view.
        depths: its true depths, `(H, W)`.
        training: the training cameras.
        of_points: the agreed depths of each training view, 0 where none is.
        true: their true depths, 0 where they are unknown.
    """
    kinds = torch.zeros(depths.shape, dtype=torch.long)
    rows, columns = (depths > 0).nonzero().unbind(1)
    own = to(cameras, "cpu", torch.float64)
    points = unproject(
        own, torch.stack([columns, rows], 1), depths[rows, columns].double(), torch.full_like(rows, view)
    )
    pixels, there = project(training, points)
    seen = torch.zeros(len(points), dtype=torch.long)
    agreed = torch.zeros(len(points), dtype=torch.bool)
    right = agreed.clone()
    for photo in range(len(true)):
        x, y, inside = nearest_pixels(pixels[:, photo], there[:, photo], *depths.mT.shape)
        known = true[photo][y, x]
        sees = inside & ~((known > 0) & (known < (1 - RIGHT) * there[:, photo]))
        found = of_points[photo][y, x]
        seen += sees
        agreed |= sees & (found > 0)
        right |= sees & ((found / there[:, photo] - 1).abs() < RIGHT)
    number = torch.where(seen < 2, 1 + seen, torch.where(right, 5, torch.where(agreed, 4, 3)))
    kinds[rows, columns] = number
    return kinds


if __name__ == "__main__":
    raise SystemExit(tyro.cli(lost) or 0)
