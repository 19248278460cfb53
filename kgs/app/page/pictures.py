"""Photos, renders and their differences as JPEG data URIs, re-encoded from their pixels and so without metadata."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs.app.files.images import eight_bits
from kgs.datasets.splits import select_evenly

GAIN = 4  # factor by which differences are amplified
_LONGER_SIDES = (1008, 756, 504, 378, 252)  # pixels; the first one with which all images fit is used
_JPEG_QUALITY = 90
MAX_THUMBNAILS = 24
_THUMBNAIL_SIZES = ((96, 80), (96, 65), (80, 60), (64, 50), (48, 40))  # height in pixels, and quality, likewise


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo and its renders."""

    name: str  # of the photo's file
    photo: Tensor  # RGB in [0, 1], `(3, H, W)`
    renders: dict[str, Tensor] = field(default_factory=dict)  # likewise, by the name of the run; "" if there is one
    caption: str = ""  # above the images; "": the name


def encoded(pictures: Sequence[Picture], max_bytes: int) -> list[dict[str, Any]]:
    """Encode all pictures in the largest size in which their data URIs fit into `max_bytes`, or in the smallest one.

    Returns:
        For each picture its name, its caption, the data URI of its photo, and its renders as tuples of the run, the
        data URI of the render, and that of the difference.
    """
    rows = list[dict[str, Any]]()
    for side in _LONGER_SIDES:
        rows = [_encoded(picture, side) for picture in pictures]
        uris = [row["photo"] for row in rows] + [uri for row in rows for _, *both in row["renders"] for uri in both]
        if sum(map(len, uris)) <= max_bytes:
            break
    return rows


def in_strip(names: Sequence[str]) -> list[int]:
    """Indices of the photos in the strip: up to `MAX_THUMBNAILS`, spread evenly, in the order of their names."""
    order = sorted(range(len(names)), key=lambda i: names[i])
    return [order[k] for k in select_evenly(len(order), min(len(order), MAX_THUMBNAILS))] if order else []


def thumbnails(photos: Sequence[Tensor], max_bytes: int) -> list[dict[str, Any]]:
    """Encode photos in the largest size in which their data URIs fit into `max_bytes`, or in the smallest one.

    Returns:
        For each photo its data URI (photo), and its width and height in pixels.
    """
    rows = list[dict[str, Any]]()
    for height, quality in _THUMBNAIL_SIZES:
        rows = []
        for photo in photos:
            shrink = min(1.0, height / photo.shape[-2])
            size = {"width": max(1, round(photo.shape[-1] * shrink)), "height": max(1, round(photo.shape[-2] * shrink))}
            rows.append({"photo": _data_uri(photo, max(size.values()), quality), **size})
        if sum(len(row["photo"]) for row in rows) <= max_bytes:
            break
    return rows


def _encoded(picture: Picture, side: int) -> dict[str, Any]:
    photo = picture.photo.detach().cpu().float()
    renders = []
    for run, render in picture.renders.items():
        render = render.detach().cpu().float().clamp(0, 1)
        difference = GAIN * (render - photo).abs()
        renders.append((run, _data_uri(render, side), _data_uri(difference, side)))
    return {
        "name": picture.name,
        "caption": picture.caption or picture.name,
        "photo": _data_uri(photo, side),
        "renders": renders,
    }


def _data_uri(image: Tensor, side: int, quality: int = _JPEG_QUALITY) -> str:
    """An image `(3, H, W)` as JPEG, reduced to at most `side` pixels."""
    array = eight_bits(image)
    height, width = array.shape[:2]
    shrink = side / max(height, width)
    if shrink < 1:
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        array = np.asarray(cv2.resize(array, size, interpolation=cv2.INTER_AREA), np.uint8)
    done, content = cv2.imencode(".jpg", array, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ArgumentError("image", "one that can be encoded as JPEG", f"{width}x{height} pixels")
    return "data:image/jpeg;base64," + base64.b64encode(content.tobytes()).decode()
