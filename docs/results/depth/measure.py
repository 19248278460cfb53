"""The depths behind dense initial points: how many agreed pixels are wrong, and how complete the right ones are."""

import os
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.bench.output import Row, markdown_table, write_results
from kgs.bench.scenes import check_scenes
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.scene import Views
from kgs.datasets.synthetic import synthetic_depths
from kgs.geometry.cameras import project, to
from kgs.geometry.multiview import unproject
from kgs.geometry.rigs import camera_centers
from kgs.init_points.agreement import confirming_views, consistent_pixels
from kgs.init_points.dense import agreed_depths, small_enough
from kgs.init_points.depth_limits import certain_points, sweep_range

SIZES = {"full": 1.0, "half": 2.0}
# Scenes, training views, and by how much their photos are larger than the full size here.
REAL = {"llff/fern": (3, 1.0), "llff/flower": (3, 1.0), "colmap/trex": (3, 1.0), "colmap/fortress": (3, 1.0)}
REAL |= {"colmap/kitchen": (12, 1.0), "colmap/monstree": (8, 1.0), "colmap/fountain": (3, 2.0)}
ROOM = "synthetic room"
ROOM_VIEWS, ROOM_SIZE = 3, (378, 504)
CONFIRMED = 2  # other photos that must confirm a depth that counts as true
SHARES = (0.01, 0.02)  # of the depth, by which a depth may be off
PIXELS = (0.5, 1.0, 2.0)  # of displacement in the neighbouring view, the same


@dataclass(frozen=True)
class Truth:
    """Some views, the depths between which they are swept, and their true depths `(V, H, W)`, 0 where unknown."""

    views: Views
    near: float
    far: float
    depths: Tensor


def depth(*, out: Path, truth: Path | None = None, quick: bool = False) -> None:
    """Precision and completeness of the agreed pixels of the training views, before points are drawn from them.

    For example:
      python measure.py --out depth --quick
      KGS_DATA=SCENES python measure.py --out depth --truth truth

    Writes depth.csv, depth.json and depth.md in five minutes. Depths of the synthetic room are exact. Of real scenes,
    those count as true that a sweep through all training photos finds and two other photos confirm: a fit from few
    views may not use them. Surveyed cameras: fountain.

    Args:
        out: folder for the results, made if it is not there.
        truth: folder where true depths are kept, made if it is not there: two versions of kgs are compared with the
            same ones.
        quick: the synthetic room alone.
    """
    data = None if quick else os.environ.get("KGS_DATA")
    if data is None:
        print("the synthetic room alone" + ("" if quick else ": KGS_DATA is not set"))
    else:
        check_scenes(Path(data), REAL)
    for folder in (out, truth):
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for size, downscale in SIZES.items():
        for name in [ROOM] if data is None else [ROOM, *REAL]:
            print(f"{name}, {size} size ...")
            known = _room(downscale) if name == ROOM else _known(Path(data or ""), name, size, truth)
            rows.append({"scene": name, "size": size} | _row(known))
    write_results(out / "depth", rows, _markdown(rows))


def _room(downscale: float) -> Truth:
    height, width = (round(length / downscale) for length in ROOM_SIZE)
    views = synthetic_scene(train_views=ROOM_VIEWS, size=(height, width)).train
    near, far = depth_range(views)
    return Truth(views, near, far, synthetic_depths(views.cameras)[:, 0])


def _known(data: Path, name: str, size: str, folder: Path | None) -> Truth:
    """The few views of a real scene with the depths that all its training photos agree on."""
    count, larger = REAL[name]
    downscale = SIZES[size] * larger
    scene, everything = (load_scene(data / name, views, downscale).train for views in (count, None))
    near, far = depth_range(scene)
    views = small_enough(scene, near, far)
    path = None if folder is None else folder / f"{name.replace('/', '-')}-{size}.pt"
    if path is not None and path.is_file():
        return Truth(views, near, far, torch.load(path))
    while everything.images.shape[-1] > views.images.shape[-1]:
        everything = everything.downsample(2)
    depths = confirmed_depths(everything, near, far, [everything.names.index(name) for name in views.names])
    if path is not None:
        torch.save(depths, path)
    return Truth(views, near, far, depths)


def depth_range(views: Views) -> tuple[float, float]:
    """The depths between which views are swept, by points that are certain."""
    cameras = to(views.cameras, "cpu", torch.float64)
    return sweep_range(certain_points(views, cameras), cameras)


def confirmed_depths(views: Views, near: float, far: float, chosen: list[int]) -> Tensor:
    """Depths `(V, H, W)` of the chosen views where enough other views confirm them, else 0."""
    cameras = to(views.cameras, "cpu", torch.float64)
    maps, certain = agreed_depths(views, near, far)
    confirmed = [confirming_views(cameras, maps, certain, view) >= CONFIRMED for view in chosen]
    depths = [torch.where(mask, maps[view].depths, 0.0) for view, mask in zip(chosen, confirmed, strict=True)]
    return torch.stack(depths).double()


def _row(known: Truth) -> Row:
    """Shares of agreed pixels that are wrong, and of pixels of known depth that are agreed and right."""
    begin = time.perf_counter()
    cameras = to(known.views.cameras, "cpu", torch.float64)
    maps, certain = agreed_depths(known.views, known.near, known.far)
    agreed = torch.stack([consistent_pixels(cameras, maps, certain, view) for view in range(len(maps))])
    seconds = time.perf_counter() - begin
    depths = torch.stack([depth_map.depths for depth_map in maps]).double()
    is_known = known.depths > 0
    judged = agreed & is_known
    off = {f"{share:.0%}": (depths / known.depths - 1).abs() > share for share in SHARES}
    moved = torch.stack([_displacements(cameras, view, depths[view], known.depths[view]) for view in range(len(maps))])
    off |= {f"{pixels:g} px": ~(moved <= pixels) for pixels in PIXELS}
    row: Row = {"views": len(maps), "height": depths.shape[1], "width": depths.shape[2], "seconds": round(seconds, 1)}
    row["agreed"] = _share(agreed)
    row |= {f"wrong by {bound}": _share(wrong[judged]) for bound, wrong in off.items()}
    return row | {f"right within {bound}": _share((judged & ~wrong)[is_known]) for bound, wrong in off.items()}


def _share(mask: Tensor) -> float:
    return round(float(mask.double().mean()), 4)


def _displacements(cameras: PinholeCamera, view: int, depths: Tensor, truth: Tensor) -> Tensor:
    """By how many pixels a view's pixels at some depths lie beside the true ones in the nearest view, `(H, W)`."""
    centers = camera_centers(cameras.extrinsics)
    distances = (centers - centers[view]).norm(dim=1)
    distances[view] = torch.inf
    nearest = int(distances.argmin())
    rows, columns = torch.meshgrid(*map(torch.arange, depths.shape), indexing="ij")
    pixels = torch.stack([columns, rows], -1).reshape(-1, 2)
    of_view = torch.full((len(pixels),), view)
    pixels = [
        project(cameras, unproject(cameras, pixels, values.reshape(-1), of_view))[0][:, nearest]
        for values in (depths, truth)
    ]
    return (pixels[0] - pixels[1]).norm(dim=1).reshape(depths.shape)


def _markdown(rows: list[Row]) -> str:
    titles = {
        "wrong by": "Agreed pixels whose depth is wrong by more than a bound, in percent of those of known depth",
        "right within": "Pixels that are agreed and right within a bound, in percent of all of known depth",
    }
    text = ""
    for kind, title in titles.items():
        names = [name for name in rows[0] if name.startswith(kind)]
        heads = ["views", "size", "agreed", *(name.removeprefix(f"{kind} ") for name in names)]
        lines = []
        for row in rows:
            shares = [f"{100 * row[name]:.1f}" for name in ("agreed", *names)]
            lines.append([row["scene"], row["views"], f"{row['width']}x{row['height']}", *shares])
        text += markdown_table(title, heads, lines, first="scene")
    return text


if __name__ == "__main__":
    raise SystemExit(tyro.cli(depth) or 0)
