"""The readers of single files, each with a tiny valid file."""

from __future__ import annotations

import json
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import torch

from kgs.datasets import Scene, synthetic_scene
from kgs.datasets.images import read_image
from kgs.fit.config import FitConfig, timetable
from kgs.fit.lpips import Lpips
from kgs.fit.outputs import write_json
from kgs.fit.settings import read_settings
from kgs.fit.starts import FirstPoints
from kgs.fit.trainer import Trainer
from kgs.model import GaussianModel
from kgs.ply import load_ply, save_ply

from .mutations import mutate_bytes, mutate_json, mutate_words
from .readers import Reader, Target, check_range, inside_checkpoint, inside_png, inside_zip

__all__ = ["FILE_READERS"]

_CONFIG = FitConfig(steps=3, evaluations=1, seed=1, sh_degree=1)
_POINTS = 12


def _write_image(folder: Path, suffix: str, channels: int = 3) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 16, channels), np.uint8)
    cv2.imwrite(str(folder / f"image.{suffix}"), noise)


def _read_image(folder: Path, suffix: str) -> None:
    check_range("image", torch.from_numpy(read_image(folder / f"image.{suffix}")), 0, 1)


def _write_ply(folder: Path, text: bool = False) -> None:
    generator = torch.Generator().manual_seed(0)
    points, colors = torch.rand(2, 5, 3, generator=generator)
    path = folder / "splat.ply"
    save_ply(path, GaussianModel.from_points(points, colors, sh_degree=1))
    if text:
        head, body = path.read_bytes().split(b"end_header\n")
        rows = np.frombuffer(body, "<f4").reshape(5, -1).tolist()
        lines = "\n".join(" ".join(map(repr, row)) for row in rows)
        path.write_bytes(head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + lines.encode() + b"\n")


def _read_ply(folder: Path) -> None:
    for name, value in load_ply(folder / "splat.ply").state_dict().items():
        check_range(name, value, -3.5e38, 3.5e38)


@cache
def _scene() -> Scene:
    return synthetic_scene(train_views=2, test_views=1, size=(16, 16))


def _write_checkpoint(folder: Path) -> None:
    points = torch.rand(_POINTS, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([0.0, 0.0, 4.0])
    trainer = Trainer(_scene(), _CONFIG, FirstPoints(points, torch.full((_POINTS, 3), 0.5), "random"))
    trainer.fit(lambda trainer, _: trainer.step == 2)
    trainer.save(folder / "checkpoint.pt")


def _read_checkpoint(folder: Path) -> None:
    trainer = Trainer.resume(_scene(), _CONFIG, folder / "checkpoint.pt")
    for name, value in trainer.model.state_dict().items():
        check_range(name, value, -3.5e38, 3.5e38)
    for parameter, state in trainer.optimizer.state.items():
        for name, value in state.items():
            check_range(name, value.expand(parameter.shape), -3.5e38, 3.5e38)


def _write_config(folder: Path) -> None:
    request = {"scene": "/photos/fern", "train_views": 3, "downscale": 8.0, "background": "black", "points": "none"}
    write_json(folder / "config.json", {"request": request, "fit": FitConfig().to_dict()})


def _read_config(folder: Path) -> None:
    _, config = read_settings(folder / "config.json")
    timetable(config)
    json.dumps(config.to_dict(), allow_nan=False)


def _write_lpips(folder: Path) -> None:
    with torch.device("meta"):
        shapes = {name: tuple(value.shape) for name, value in Lpips("alexnet").state_dict().items()}
    features = {name: np.zeros(shape, np.float16) for name, shape in shapes.items() if name.startswith("features")}
    heads = {name: np.linspace(0, 1, shape[0], dtype=np.float32) for name, shape in shapes.items() if "lin" in name}
    np.savez_compressed(folder / "alexnet_features.npz", **features)  # type: ignore[arg-type]  # numpy's stubs
    np.savez(folder / "lpips_lin_alexnet.npz", **heads)  # type: ignore[arg-type]


def _read_lpips(folder: Path) -> None:
    for name, value in Lpips.load(folder, "alexnet").state_dict().items():
        check_range(name, value, -3.5e38, 3.5e38)


def _image_reader(name: str, suffix: str, *targets: Target, channels: int = 3) -> Reader:
    path = f"image.{suffix}"
    return Reader(
        name,
        partial(_write_image, suffix=suffix, channels=channels),
        partial(_read_image, suffix=suffix),
        targets or (Target(path, mutate_bytes),),
    )


_PNG, _HEADS = "image.png", "lpips_lin_alexnet.npz"
_CHECKPOINT = "checkpoint.pt"
FILE_READERS = (
    Reader("PLY, binary", _write_ply, _read_ply, (Target("splat.ply", mutate_bytes),)),
    Reader("PLY, ascii", partial(_write_ply, text=True), _read_ply, (Target("splat.ply", mutate_words),)),
    Reader(
        "checkpoint",
        _write_checkpoint,
        _read_checkpoint,
        (
            Target(_CHECKPOINT, mutate_bytes),
            Target(_CHECKPOINT, inside_checkpoint(mutate_bytes, 2)),
            *[Target(_CHECKPOINT, inside_checkpoint(mutate_json, 1))] * 3,
        ),
    ),
    Reader("config.json", _write_config, _read_config, (Target("config.json", mutate_json),)),
    Reader(
        "LPIPS weights",
        _write_lpips,
        _read_lpips,
        (
            Target(_HEADS, mutate_bytes),
            Target(_HEADS, inside_zip(mutate_bytes)),
            Target("alexnet_features.npz", mutate_bytes),
        ),
        share=0.3,
    ),
    _image_reader("PNG", "png", Target(_PNG, mutate_bytes), Target(_PNG, inside_png(mutate_bytes)), channels=4),
    _image_reader("JPEG", "jpg"),
    _image_reader("WebP", "webp"),
    _image_reader("BMP", "bmp"),
    _image_reader("TIFF", "tif"),
)
