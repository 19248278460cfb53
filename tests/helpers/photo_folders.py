"""Folders of photos as a user has them: three views of two painted planes, and what phones and people do to files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from init_point_scenes import CENTERS, cameras, painted_planes
from kornia.geometry.camera import PinholeCamera

from kgs.app.sfm import read
from kgs.app.sfm.find import find_photos, notes_on
from kgs.datasets.masks import find_masks

NAMES = ("IMG_1.png", "IMG_2.png", "IMG_3.png")
SMALL = (160, 120)


def open_photos(paths: Sequence[Path], masks: Path | None = None) -> list[read.OpenPhoto]:
    """Photos of one folder with their masks, as a command opens them."""
    return read.open_photos(paths, find_masks(paths, paths[0].parent, masks))


def notes_of(folder: Path, masks: Path | None = None) -> list[str]:
    """What a command says of a folder of photos before it reads them."""
    photos = find_photos(folder)
    return notes_on(folder, photos, find_masks(photos, folder, masks))


def planes(posed: PinholeCamera | None = None) -> np.ndarray:
    """The three views, `(3, H, W, 3)` BGR, from `cameras()` unless others are given."""
    images = painted_planes(posed).images.permute(0, 2, 3, 1).numpy()
    return np.ascontiguousarray((images * 255).round().astype(np.uint8)[..., ::-1])


def small_cameras() -> PinholeCamera:
    """Of the smallest photos whose cameras are found, which takes a second; farther apart than `cameras()`."""
    return cameras(1.5 * CENTERS, -0.075, SMALL)


def small_planes() -> np.ndarray:
    """What they see."""
    return planes(small_cameras())


def write_planes(folder: Path, images: np.ndarray | None = None) -> Path:
    """PNGs of `planes()`, or of other images."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(NAMES, planes() if images is None else images, strict=True):
        cv2.imwrite(str(folder / name), image)
    return folder


def write_photos(folder: Path, images: Sequence[np.ndarray], films: Sequence[int] = ()) -> Path:
    """JPEGs of these; `films`: the focal length that the Exif of each says, in mm of 35 mm film (0: none)."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, (image, film) in enumerate(zip(images, films or [0] * len(images), strict=True), 1):
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        (folder / f"IMG_{i}.jpg").write_bytes(with_exif(data, exif(film=film)))
    return folder


def close(degrees: float) -> np.ndarray:
    """The same planes from centres so far apart: half a degree fits any focal length, one most."""
    return planes(cameras(0.2 * degrees * CENTERS, -0.02 * degrees))


def exif(order: str = "<", orientation: int = 1, film: int = 0, focal: float = 0, density: float = 0, width: int = 0):
    """A TIFF block with these tags: what a camera writes into a photo."""
    shorts = [(0x0112, orientation)]
    inner = [(0xA405, 3, film), (0x920A, 5, focal), (0xA20E, 5, density), (0xA210, 3, 3), (0xA002, 4, width)]
    inner = [row for row in inner if row[2]]
    start = 8 + 2 + 12 * (len(shorts) + 1) + 4
    far = start + 2 + 12 * len(inner) + 4
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "I", 8)
    head += struct.pack(order + "H", len(shorts) + 1)
    head += b"".join(struct.pack(order + "HHIHH", tag, 3, 1, value, 0) for tag, value in shorts)
    head += struct.pack(order + "HHII", 0x8769, 4, 1, start) + bytes(4) + struct.pack(order + "H", len(inner))
    values = b""
    for tag, kind, value in inner:
        if kind == 5:
            head += struct.pack(order + "HHII", tag, 5, 1, far + len(values))
            values += struct.pack(order + "II", round(value * 100), 100)
        else:
            head += struct.pack(order + ("HHIHH" if kind == 3 else "HHII"), tag, kind, 1, value, *[0] * (kind == 3))
    return head + bytes(4) + values


def with_exif(jpeg: bytes, block: bytes) -> bytes:
    body = b"Exif\0\0" + block
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]
