"""Beyond the photos: what cameras see that lie farther out than those of the training views.

Of the synthetic room the truth is known everywhere: cameras 1, 2 and 3 times as far from the middle of the training
cameras as these, over the pixels whose surface a training view shows. Of real scenes the outermost photos are held out
and the most central ones are trained on.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import product
from math import ceil, inf
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.errors import DataError
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

from .cells import fit_and_measure, fit_config, load_lpips
from .grid import Cell
from .presets import AUTO

ROOM, ROOM_VIEWS = "room", 3  # the synthetic scene and its training views
PHOTOS = {"llff/fern": 3, "colmap/trex": 3, "nerfstudio/fox": 12}  # the real scenes and theirs
OUT = (1, 2, 3)  # distances from the middle of the training cameras, over theirs
SIZE = (189, 252)  # pixels of the room's views, height and width
CAMERAS = 6  # at each of these distances
OUTER = 0.25  # share of a real scene's photos that are held out


class Target(NamedTuple):
    """Views from beyond the photos, and the pixels of each that count, bool `(H, W)`."""

    views: Views
    shown: Sequence[Tensor]


def beyond_cells(data: Path | None) -> list[Cell]:
    """The cells of the preset: three seeds of the room, then, with a folder `data`, of the real ones.

    DataError: `data` lacks a scene.
    """
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
        data: the folder of the real scenes; DataError: the scene is not there or damaged.
        lpips_weights: a folder with the weights of VGG16 and LPIPS, or None to leave LPIPS out.

    Returns:
        What every cell stores of a fit; "test" and "train": the means of `evaluate`; "beyond": by distance, as text,
        what `measure_target` returns; of real scenes, whose test views are the outer ones, it is empty.
    """
    config, _ = fit_config("dense", cell["seed"], cell["fit"])
    scene = _scene(cell["scene"], cell["views"], cell["downscale"], data)
    points = choose_points(scene, config)
    lpips = load_lpips(lpips_weights)
    _, fit, stored = fit_and_measure(scene, config, points, lpips)
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
    if data is None:
        raise DataError(name, "", "the environment variable KGS_DATA to name the folder of this scene")
    return from_the_middle(load_scene(Path(data) / name, downscale=downscale, hold_out=0), views)
