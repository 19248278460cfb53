"""Names and writes PNGs of views."""

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

if TYPE_CHECKING:
    from torch import Tensor

_ENDING = r"(?<=[^./\\])\.[^./\\]*$"  # of a view's name; the name of a hidden file is no ending
_LONGEST = 120  # bytes of a picture's name


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
    import cv2  # here, because commands look at files before anything heavy is loaded

    from .images import eight_bits

    ok, content = cv2.imencode(".png", eight_bits(image))
    if not ok:
        raise DataError(path, "", "an image that can be encoded", f"shape {tuple(image.shape)}")
    write_whole(path, content.tobytes())
