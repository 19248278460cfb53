"""Checks the folder of a command's results, and writes PNGs."""

import hashlib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import DataError
from kgs._support.json_files import write_whole
from kgs.datasets.folders import CAMERAS_REPORT, LAYOUT_FILES, list_images

from .publishing import is_own

if TYPE_CHECKING:
    from torch import Tensor

FILMS = ("turntable.mp4", "turntable.webm")  # a fit writes one of them
SPLAT_EXPORTS = ("cameras.json", "splat.compressed.ply", "splat.glb")  # for other programs
EXPORTS = (*SPLAT_EXPORTS, "preview.jpg", *FILMS)  # and for messengers
_SCENES = ("sparse", *LAYOUT_FILES.values())
_ENDING = r"(?<=[^./\\])\.[^./\\]*$"  # of a view's name; the name of a hidden file is no ending
_LONGEST = 120  # bytes of a picture's name


def check_folder(out: Path, scene: Path | None = None, make: bool = True) -> None:
    """Create the folder for results, after checking that it can be written to and holds no scene of the user.

    Nothing is written next to the photos of the folder `scene`. With `make` False the folder is only checked. A folder
    that cannot be used is a DataError.
    """
    there = next(path for path in (out, *out.absolute().parents) if os.path.lexists(path))
    if not there.is_dir():
        raise DataError(out, "", "a folder for results", f"{there}, which is none")
    if not os.access(there, os.W_OK | os.X_OK):
        raise DataError(out, "", "a folder that can be written to", f"no permission for {there}")
    inside = scene is not None and out.resolve().is_relative_to(scene.resolve())
    has_photos = inside and there == out and not is_own(out, *(path.name for path in list_images(out)))
    # kgs wrote these: the cameras that a former run found, or those of the demo
    of_photos = ("sparse", LAYOUT_FILES["nerfstudio"]) if (out / CAMERAS_REPORT).exists() else ()
    if has_photos or any((out / name).exists() for name in _SCENES if name not in of_photos):
        raise DataError(out, "", "a folder for results", "photos or files of a scene", advice="choose another folder")
    if make:
        out.mkdir(parents=True, exist_ok=True)


def png_names(views: Iterable[str]) -> dict[str, str]:
    """A unique file name for a render of each view: folders become part of the name, the ending becomes .png.

    If two views would have the same name (ignoring case), or a name is too long, a hash of the view's name is added.
    """
    plain = {view: re.sub(r"[\\/\x00-\x1f\ud800-\udfff]", "_", re.sub(_ENDING, "", view)) for view in views}
    folded = {view: unicodedata.normalize("NFC", stem).casefold() for view, stem in plain.items()}
    counts = Counter(folded.values())
    names = {}
    for view, stem in plain.items():
        if counts[folded[view]] > 1 or len(os.fsencode(stem)) > _LONGEST:
            short = os.fsencode(stem)[: _LONGEST - 13].decode(errors="ignore")
            stem = f"{short}-{hashlib.sha256(os.fsencode(view)).hexdigest()[:12]}"
        names[view] = f"{stem}.png"
    return names


def write_png(path: Path, image: "Tensor") -> None:
    """Write an RGB or RGBA image `(3 or 4, H, W)`: of 8 bits, or clamped to [0, 1] and rounded to 8 bits.

    Alpha is straight, as PNG has it: the colours are not multiplied by it.
    """
    import cv2  # here, because the command looks at folders before anything heavy is loaded

    from .images import eight_bits

    ok, content = cv2.imencode(".png", eight_bits(image))
    if not ok:
        raise DataError(path, "", "an image that can be encoded", f"shape {tuple(image.shape)}")
    write_whole(path, content.tobytes())
