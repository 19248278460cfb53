"""Tiny valid scenes, one in each layout, and tiny valid files: what reader tests begin with.

A scene has three photos of 16 x 12 pixels and, in a COLMAP model, two points.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import torch

from kgs._support.json_files import write_json
from kgs.datasets.image_file import Image, ImageFile
from kgs.fit.config import FitConfig
from kgs.metrics import lpips
from kgs.metrics.lpips import Lpips
from kgs.model import GaussianModel
from kgs.ply import save_ply

Object = dict[str, Any]
_SIZE = (16, 12)
_NAMES = ("0.png", "1.png", "2.png")
_TURN = (0.998, 0.02, -0.05, 0.03)  # of the second photo, w x y z, not of unit length
_OPENCV = (14.0, 14.5, 8.2, 6.1, -0.05, 0.01, 0.001, -0.001)
_RADIAL = (14.0, 8.0, 6.0, -0.02)


def write_photos(folder: Path, channels: int = 3, count: int = 3, size: tuple[int, int] = _SIZE) -> None:
    """Noise; `size` is (width, height)."""
    folder.mkdir(parents=True, exist_ok=True)
    noise = np.random.default_rng(0).integers(0, 255, (count, *size[::-1], channels), np.uint8)
    for i, image in enumerate(noise):
        cv2.imwrite(str(folder / f"{i}.png"), image)


def write_llff(root: Path, count: int = 3, size: tuple[int, int] = _SIZE, folder: str = "images") -> None:
    write_llff_rows(root, count, size)
    write_photos(root / folder, count=count, size=size)


def write_llff_rows(root: Path, count: int, size: tuple[int, int], focal: float = 14.0) -> None:
    """Axes down, right and backward, the centre, (height, width, focal length), then two depths."""
    width, height = size
    row = np.array([0, 1, 0, 0, height, 1, 0, 0, 0, width, 0, 0, -1, 0, focal, 1, 9], dtype=float)
    rows = np.tile(row, (count, 1))
    rows[:, 3] = np.linspace(0, 1, count)
    np.save(root / "poses_bounds.npy", rows)


def write_colmap(root: Path, text: bool = False, rig: bool = False) -> None:
    """Two lenses, three photos, two points; as COLMAP writes them, from version 3.12 on with a rig and its frames."""
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    write_photos(root / "images")
    cameras = {1: ("OPENCV", 4, _OPENCV), 2: ("SIMPLE_RADIAL", 2, _RADIAL)}
    poses = [
        ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (_TURN, (0.5, 0.0, 0.1)),
        ((-1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ]
    images = [(i + 1, quat, shift, 1 + i % 2, _NAMES[i]) for i, (quat, shift) in enumerate(poses)]
    points = [(7, (0.1, 0.2, 5.0), (255, 0, 51), (1, 0, 2, 0, 3, 0)), (8, (0.3, -0.2, 6.0), (1, 2, 3), (2, 1, 3, 1))]
    if text:
        lens = [f"{i} {name} 16 12 {_words(numbers)}" for i, (name, _, numbers) in cameras.items()]
        pose = [
            f"{i} {_words(q)} {_words(t)} {camera} {name}\n3.5 4.5 7 5.5 6.5 -1" for i, q, t, camera, name in images
        ]
        dots = [f"{i} {_words(xyz)} {_words(rgb)} 0.5 {_words(track)}" for i, xyz, rgb, track in points]
        parts = {"cameras": lens, "images": pose, "points3D": dots}
        if rig:
            parts["rigs"] = ["5 2 CAMERA 1 CAMERA 2 1 1.0 0.0 0.0 0.0 0.0 0.0 0.0"]
            parts["frames"] = [f"{i} 5 {_words(q)} {_words(t)} 1 CAMERA {camera} {i}" for i, q, t, camera, _ in images]
        for stem, lines in parts.items():
            (folder / f"{stem}.txt").write_text("\n".join([f"# {stem}", *lines, ""]))
        return
    data = struct.pack("<Q", 2)
    for i, (_, model, numbers) in cameras.items():
        data += struct.pack(f"<IiQQ{len(numbers)}d", i, model, 16, 12, *numbers)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", 3)
    for i, quat, shift, camera, name in images:
        data += struct.pack("<I7dI", i, *quat, *shift, camera) + name.encode() + b"\0"
        data += struct.pack("<Qddqddq", 2, 3.5, 4.5, 7, 5.5, 6.5, -1)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", 2)
    for i, xyz, rgb, track in points:
        data += struct.pack(f"<Q3d3BdQ{len(track)}I", i, *xyz, *rgb, 0.5, len(track) // 2, *track)
    (folder / "points3D.bin").write_bytes(data)
    if rig:
        data = struct.pack("<QIIiIiIB7d", 1, 5, 2, 0, 1, 0, 2, 1, 1, 0, 0, 0, 0, 0, 0)
        (folder / "rigs.bin").write_bytes(data)
        data = struct.pack("<Q", 3)
        for i, quat, shift, camera, _ in images:
            data += struct.pack("<II7dIiIQ", i, 5, *quat, *shift, 1, 0, camera, i)
        (folder / "frames.bin").write_bytes(data)


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(map(repr, numbers))


def _matrix(i: int) -> list[list[float]]:
    """Camera-to-world, turned a little about y and moved along x."""
    c, s = math.cos(0.1 * i), math.sin(0.1 * i)
    return [[c, 0.0, s, 0.5 * i], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 4.0], [0.0, 0.0, 0.0, 1.0]]


def write_transforms(path: Path, top: Object, frames: Mapping[str, Object]) -> Path:
    """Such a file: what all frames have, and by the name of its photo what a frame has itself."""
    entries = [
        {"file_path": name, "transform_matrix": _matrix(i), **own} for i, (name, own) in enumerate(frames.items())
    ]
    path.write_text(json.dumps({**top, "frames": entries}))
    return path


def update_json(path: Path, frame: int | None = None, **values: Any) -> None:
    """Sets keys of an object in a file, or of one of its `frames`."""
    content = json.loads(path.read_text())
    (content if frame is None else content["frames"][frame]).update(values)
    path.write_text(json.dumps(content))


def write_blender(root: Path, train: int = 3, test: int = 3) -> None:
    for split, count in (("train", train), ("test", test)):
        write_photos(root / split, channels=4, count=count)
        frames: dict[str, Object] = {f"./{split}/{i}": {} for i in range(count)}
        write_transforms(root / f"transforms_{split}.json", {"camera_angle_x": 0.7}, frames)


def write_nerfstudio(root: Path) -> None:
    write_photos(root / "images")
    lens = {"camera_model": "OPENCV", "fl_x": 14.0, "fl_y": 14.5, "cx": 8.2, "cy": 6.1, "w": 16, "h": 12}
    fisheye = {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": 0.001}
    frames: dict[str, Object] = {"images/0.png": {}, "images/1.png": fisheye, "images/2.png": {}}
    write_transforms(root / "transforms.json", {**lens, "k1": -0.05, "k2": 0.01, "p1": 0.001}, frames)


def read_image(path: Path) -> Image:
    """The pixels of an image in a file that is opened for this alone."""
    return ImageFile(path).read()


def write_image(folder: Path, suffix: str, channels: int = 3) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (12, 16, channels), np.uint8)
    cv2.imwrite(str(folder / f"image.{suffix}"), noise)


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_of(rows: bytes, width: int, height: int, color_type: int = 0) -> bytes:
    """A PNG of 8 bits, of rows that are compressed already."""
    head = struct.pack(">IIBBBBB", width, height, 8, color_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", head) + png_chunk(b"IDAT", rows) + png_chunk(b"IEND", b"")


def plain_png(width: int, height: int) -> bytes:
    """A black PNG whose data are as small as they can be: no encoder at hand writes it without taking the memory."""
    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(width + 1)) for _ in range(height)) + packer.flush()
    return png_of(rows, width, height)


def write_ply(folder: Path, text: bool = False) -> None:
    generator = torch.Generator().manual_seed(0)
    points, colors = torch.rand(2, 5, 3, generator=generator)
    path = folder / "splat.ply"
    save_ply(path, GaussianModel.from_points(points, colors, sh_degree=1))
    if text:
        head, body = path.read_bytes().split(b"end_header\n")
        header = head.decode().splitlines()
        comments = [line for line in header if line.startswith("comment")]  # most programs write them first
        elements = [line for line in header[2:] if line not in comments]
        rows = [" ".join(map(repr, row)) for row in np.frombuffer(body, "<f4").reshape(5, -1).tolist()]
        lines = ["ply", "format ascii 1.0", *comments, *elements, "end_header", *rows]
        path.write_text("".join(f"{line}\n" for line in lines))


def write_config(folder: Path) -> None:
    request = {"scene": "/photos/fern", "train_views": 3, "downscale": 8.0, "background": "black", "points": "none"}
    write_json(folder / "config.json", {"request": request, "fit": FitConfig().to_dict()})


def write_lpips(folder: Path) -> None:
    with torch.device("meta"), narrow_lpips():
        shapes = {name: tuple(value.shape) for name, value in Lpips().state_dict().items()}
    features = {name: np.zeros(shape, np.float16) for name, shape in shapes.items() if name.startswith("features")}
    heads = {name: np.linspace(0, 1, shape[0], dtype=np.float32) for name, shape in shapes.items() if "lin" in name}
    np.savez_compressed(folder / "vgg16_features.npz", **features)  # type: ignore[arg-type]  # numpy's stubs
    np.savez(folder / "lpips_lin_vgg16.npz", **heads)  # type: ignore[arg-type]


def narrow_lpips() -> AbstractContextManager[object]:
    """Within it the network of LPIPS is narrow: its files are read in milliseconds."""
    return mock.patch.object(lpips, "BLOCKS", ((4, 4), (6, 6), (8, 8, 8), (8, 8, 8), (8, 8, 8)))
