"""Photos, renders and their differences as JPEG in data URIs: they carry pixels and nothing else."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from kgs.io.images import eight_bits

GAIN = 4  # by which differences are shown stronger
_SIDES = (1008, 756, 504, 378, 252)  # pixels of the longer side, the first that fits
_QUALITY = 90  # of JPEG


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo and what was rendered in its place.

    Args:
        name: of the photo's file.
        photo: RGB in [0, 1], `(3, H, W)`.
        renders: of the same shape, by the name of the run; "" where there is one run.
        caption: what to say of it; "" for its name.
    """

    name: str
    photo: Tensor
    renders: dict[str, Tensor] = field(default_factory=dict)
    caption: str = ""


def encoded(pictures: Sequence[Picture], most_bytes: int) -> list[dict[str, Any]]:
    """Name, caption, photo and renders (run, render, difference) of each, in the largest size in which all fit.

    The smallest of these sizes is taken where none does.
    """
    for side in _SIDES:
        rows = [_encoded(picture, side) for picture in pictures]
        uris = [uri for row in rows for uri in (row["photo"], *(u for _, *pair in row["renders"] for u in pair))]
        if sum(map(len, uris)) <= most_bytes:
            break
    return rows


def _encoded(picture: Picture, side: int) -> dict[str, Any]:
    photo = picture.photo.detach().cpu().float()
    renders = []
    for run, render in picture.renders.items():
        render = render.detach().cpu().float().clamp(0, 1)
        renders.append((run, _uri(render, side), _uri(GAIN * (render - photo).abs(), side)))
    name = picture.name
    return {"name": name, "caption": picture.caption or name, "photo": _uri(photo, side), "renders": renders}


def _uri(image: Tensor, side: int) -> str:
    array = eight_bits(image)
    height, width = array.shape[:2]
    shrink = side / max(height, width)
    if shrink < 1:
        size = max(1, round(width * shrink)), max(1, round(height * shrink))
        array = np.asarray(cv2.resize(array, size, interpolation=cv2.INTER_AREA), np.uint8)
    done, content = cv2.imencode(".jpg", array, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise ValueError(f"image: expected one that can be encoded, got {width}x{height} pixels")
    return "data:image/jpeg;base64," + base64.b64encode(content.tobytes()).decode()
