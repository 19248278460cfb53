"""What a command leaves behind: metrics.json and PNGs, whole or not at all, and never in place of a user's file."""

from __future__ import annotations

import hashlib
import json
import os
import re
import unicodedata
import zlib
from collections import Counter
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from kgs.datasets.images import list_images
from kgs.errors import DataError

__all__ = ["check_folder", "is_own", "png_names", "remove_others", "write_json", "write_png", "write_whole"]

PNG_MARK = b"Software\0kgs"
_MARKS = {".png": (PNG_MARK,), ".ply": (b"\ncomment kgs ",), ".json": (b'"kgs": "', b'"timetable": {')}
_SCENES = ("poses_bounds.npy", "sparse", "transforms.json", "transforms_train.json")
_ENDING = r"(?<=[^./\\])\.[^./\\]*$"  # of a view's name, that of a hidden file is none
_LONGEST = 120  # bytes of a picture's name


def check_folder(out: Path, files: Iterable[str], scene: Path | None = None, make: bool = True) -> None:
    """Make the folder for results, once it is sure that this command can write there and overwrites no user's file.

    Args:
        out: the folder.
        files: what the command is going to write, relative to `out`.
        scene: the scene's folder; no results go where it keeps its own photos.
        make: False only looks.

    Raises:
        DataError: `out` is no folder, cannot be written to, is a scene or holds photos of `scene`, or has one of
            `files` that kgs did not write.
    """
    advice = "choose another folder with -o"
    there = next(path for path in (out, *out.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise DataError(out, "", f"expected a folder for results, but {there} is none")
    if not os.access(there, os.W_OK | os.X_OK):
        raise DataError(out, "", f"results cannot be written there: no permission for {there}")
    inside = scene is not None and out.resolve().is_relative_to(scene.resolve())
    photos = [path for path in list_images(out) if not is_own(path)] if inside and there == out else []
    if photos or any((out / name).exists() for name in _SCENES):
        raise DataError(out, "", f"holds files of a scene: {advice}")
    for path in (out / name for name in files):
        folder = path.parent
        if (os.path.lexists(path) and not is_own(path)) or (os.path.lexists(folder) and not folder.is_dir()):
            raise DataError(path, "", f"was not written by kgs and would be overwritten: {advice}")
    if make:
        out.mkdir(parents=True, exist_ok=True)


def is_own(path: Path) -> bool:
    """Whether kgs wrote this PNG, PLY or JSON file."""
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        content = file.read(2**26 if path.suffix == ".json" else 2**12)
    return any(mark in content for mark in _MARKS.get(path.suffix, ()))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; a link stays one.

    Raises:
        OSError: it cannot be written; what was there is untouched.
    """
    path = path.resolve()
    temporary = path.with_name(f".{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    write_whole(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def png_names(views: Iterable[str]) -> dict[str, str]:
    """A file name of its own for a render of each view.

    Folders in a view's name become part of it, and the ending becomes .png. Where that gives two views the same name
    (capitals do not count), or one that is too long, a hash of the view's name is added.
    """
    plain = {view: re.sub(r"[\\/\x00-\x1f]", "_", re.sub(_ENDING, "", view)) for view in views}
    folded = {view: unicodedata.normalize("NFC", stem).casefold() for view, stem in plain.items()}
    counts = Counter(folded.values())
    names = {}
    for view, stem in plain.items():
        if counts[folded[view]] > 1 or len(os.fsencode(stem)) > _LONGEST:
            short = os.fsencode(stem)[: _LONGEST - 13].decode(errors="ignore")
            stem = f"{short}-{hashlib.sha256(os.fsencode(view)).hexdigest()[:12]}"
        names[view] = f"{stem}.png"
    return names


def write_png(path: Path, image: Tensor) -> None:
    """Write an RGB image `(3, H, W)`, clamped to [0, 1] and rounded to 8 bits, marked as one of kgs."""
    array = (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    ok, content = cv2.imencode(".png", np.ascontiguousarray(array[:, :, ::-1]))
    if not ok:
        raise DataError(path, "", "expected an image that can be encoded, got another")
    chunk = b"tEXt" + PNG_MARK
    mark = (len(PNG_MARK)).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big")
    data = content.tobytes()
    header = 33  # the signature and the first chunk
    write_whole(path, data[:header] + mark + data[header:])


def remove_others(folder: Path, keep: Collection[str]) -> None:
    """Remove the pictures of a former run: PNGs that kgs wrote, but for those named in `keep`."""
    for path in folder.glob("*.png"):
        if path.name not in keep and is_own(path):
            path.unlink()
