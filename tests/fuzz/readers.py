"""The readers of kgs, each with a tiny valid set of files, the damage that is done to them, and what must hold."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import torch
import trimesh
from damage import (
    Damage,
    damaged_bytes,
    damaged_checkpoint,
    damaged_json,
    damaged_png_chunk,
    damaged_text,
    damaged_zip_member,
)
from tiny_scenes import (
    narrow_lpips,
    read_image,
    write_blender,
    write_colmap,
    write_config,
    write_image,
    write_llff,
    write_lpips,
    write_nerfstudio,
    write_ply,
)
from torch import Tensor

from kgs.app.saved_fit import read_request
from kgs.datasets import Scene, Views, load_scene, synthetic_scene
from kgs.fit.config import FitConfig
from kgs.fit.plan import make_plan
from kgs.fit.trainer import Trainer
from kgs.init_points import InitialPoints
from kgs.init_points.files import read_points
from kgs.metrics.lpips import Lpips
from kgs.ply import load_ply

Target = tuple[str, Damage]  # a file of the set, and how it is damaged


class Unsound(Exception):
    """A reader let numbers pass that are not finite or not valid."""


@dataclass(frozen=True)
class Reader:
    """One reader of kgs.

    Args:
        name: the id of its tests.
        write: writes a valid set of files into a folder.
        read: reads them and checks what it got; raises DataError for files that are refused and `Unsound` for numbers
            that should not have passed.
        targets: the files that are damaged, one at a time.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], None]
    targets: tuple[Target, ...]


def check_range(name: str, value: Tensor, low: float = -1e30, high: float = 1e30) -> None:
    """Raise Unsound where a number is outside [low, high] or NaN."""
    if not bool(((value >= low) & (value <= high)).all()):
        raise Unsound(f"{name}: expected numbers from {low:g} to {high:g}")


_CONFIG = FitConfig(steps=3, evaluations=1, seed=1, sh_degree=1)
_POINTS = 12


def _read_image(folder: Path, suffix: str) -> None:
    check_range("image", torch.from_numpy(read_image(folder / f"image.{suffix}")), 0, 1)


def _read_ply(folder: Path) -> None:
    for name, value in load_ply(folder / "splat.ply").state_dict().items():
        minimum = (
            -math.inf if name in ("log_scales", "opacity_logits") else -3.5e38
        )  # of a flat disc, of an opacity of 0
        maximum = math.inf if name == "opacity_logits" else 3.5e38
        check_range(name, value, minimum, maximum)


def check_scene(scene: Scene) -> None:
    """Raise Unsound where a scene holds numbers that are not finite or not valid."""
    for views in filter(None, (scene.train, scene.test, scene.train_full_size)):
        _check_views(views)
    check_range("points", scene.points)
    check_range("point_colors", scene.point_colors, 0, 1)
    check_range("offset", scene.offset)
    check_range("background", scene.background, 0, 1)


def _check_views(views: Views) -> None:
    check_range("images", views.images, 0, 1)
    if views.alphas is not None:
        check_range("alphas", views.alphas, 0, 1)
    check_range("intrinsics", views.cameras.intrinsics)
    check_range("extrinsics", views.cameras.extrinsics)
    check_range("focal lengths", torch.stack([views.cameras.fx, views.cameras.fy]), 1e-30)
    rotation = views.cameras.extrinsics[:, :3, :3].double()
    if float((rotation.mT @ rotation - torch.eye(3)).abs().max()) > 1e-5 or float(torch.linalg.det(rotation).min()) < 0:
        raise Unsound("extrinsics: expected right-handed rotations")
    if len(set(views.names)) < len(views.names):
        raise Unsound("names: expected each one once")


@cache
def _scene() -> Scene:
    return synthetic_scene(train_views=2, test_views=1, size=(16, 16))


def _write_checkpoint(folder: Path) -> None:
    points = torch.rand(_POINTS, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, 4.0])
    first = InitialPoints(points, torch.full((_POINTS, 3), 0.5), "random")
    trainer = Trainer(_scene(), make_plan(_scene(), _CONFIG, first), first)
    trainer.fit(lambda trainer, _: trainer.step == 2)
    trainer.save(folder / "checkpoint.safetensors")


def _read_checkpoint(folder: Path) -> None:
    trainer = Trainer.resume(_scene(), _CONFIG, folder / "checkpoint.safetensors")
    for name, value in trainer.model.state_dict().items():
        check_range(name, value, -3.5e38, 3.5e38)
    for parameter, state in trainer.state.optimizer.state.items():
        for name in ("exp_avg", "exp_avg_sq"):
            check_range(name, state[name].expand(parameter.shape), -3.5e38, 3.5e38)


def _read_config(folder: Path) -> None:
    json.dumps(read_request(folder / "config.json").to_dict(), allow_nan=False)


def _read_lpips(folder: Path) -> None:
    with narrow_lpips():
        module = Lpips.load(folder)
    for name, value in module.state_dict().items():
        check_range(name, value, -3.5e38, 3.5e38)


def _write_points(folder: Path, kind: str) -> None:
    points, colors = torch.rand(2, 5, 3, generator=torch.Generator().manual_seed(0)).numpy()
    trimesh.PointCloud(points, (255 * colors).astype("uint8")).export(folder / f"points.{kind}")


def _read_cloud(folder: Path, kind: str) -> None:
    points, colors = read_points(folder / f"points.{kind}")
    check_range("points", points, -3.5e38, 3.5e38)
    check_range("colors", colors, 0, 1)


def _image_reader(name: str, suffix: str, *targets: Target, channels: int = 3) -> Reader:
    path = f"image.{suffix}"
    return Reader(
        name,
        partial(write_image, suffix=suffix, channels=channels),
        partial(_read_image, suffix=suffix),
        targets or ((path, damaged_bytes),),
    )


def _read(root: Path, points: str = "none", downscale: float | None = None) -> None:
    check_scene(load_scene(root, downscale=downscale, points=points))


_MODEL = ("cameras", "images", "points3D", "rigs", "frames")
SCENE_READERS = (
    Reader("LLFF", write_llff, partial(_read, downscale=2), (("poses_bounds.npy", damaged_bytes),)),
    Reader(
        "COLMAP, binary",
        partial(write_colmap, rig=True),
        partial(_read, points="model-points"),
        tuple((f"sparse/0/{stem}.bin", damaged_bytes) for stem in _MODEL),
    ),
    Reader(
        "COLMAP, text",
        partial(write_colmap, text=True, rig=True),
        partial(_read, points="model-points"),
        tuple((f"sparse/0/{stem}.txt", damaged_text) for stem in _MODEL),
    ),
    Reader(
        "Blender",
        write_blender,
        partial(_read, downscale=1.5),
        tuple((f"transforms_{split}.json", damaged_json) for split in ("train", "test")),
    ),
    Reader("nerfstudio", write_nerfstudio, _read, (("transforms.json", damaged_json),)),
)
_PNG, _HEADS = "image.png", "lpips_lin_vgg16.npz"
_CHECKPOINT = "checkpoint.safetensors"
_CLOUDS = {"ply": ("points.ply", damaged_bytes), "xyz": ("points.xyz", damaged_text)}
FILE_READERS = (
    Reader("PLY, binary", write_ply, _read_ply, (("splat.ply", damaged_bytes),)),
    Reader("PLY, ascii", partial(write_ply, text=True), _read_ply, (("splat.ply", damaged_text),)),
    Reader(
        "checkpoint",
        _write_checkpoint,
        _read_checkpoint,
        (
            (_CHECKPOINT, damaged_bytes),
            *[(_CHECKPOINT, damaged_checkpoint)] * 3,
        ),
    ),
    Reader("config.json", write_config, _read_config, (("config.json", damaged_json),)),
    Reader(
        "LPIPS weights",
        write_lpips,
        _read_lpips,
        (
            (_HEADS, damaged_bytes),
            (_HEADS, damaged_zip_member),
            ("vgg16_features.npz", damaged_bytes),
        ),
    ),
    _image_reader("PNG", "png", (_PNG, damaged_bytes), (_PNG, damaged_png_chunk), channels=4),
    _image_reader("JPEG", "jpg"),
    _image_reader("WebP", "webp"),
    _image_reader("BMP", "bmp"),
    _image_reader("TIFF", "tif"),
    _image_reader("TIFF, RGBA", "tif", channels=4),
    *(
        Reader(f"points, {kind}", partial(_write_points, kind=kind), partial(_read_cloud, kind=kind), (target,))
        for kind, target in _CLOUDS.items()
    ),
)
READERS = (*SCENE_READERS, *FILE_READERS)
