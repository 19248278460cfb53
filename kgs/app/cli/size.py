"""How large the photos of a fit are: what --size, --downscale, --detail and --preset ask for."""

import re
from dataclasses import replace
from typing import TYPE_CHECKING

from kgs._support.errors import ArgumentError, quoted
from kgs.app.console import say
from kgs.app.details import DETAILS

from .checks import check_side

if TYPE_CHECKING:
    from kgs.app.scene_request import SceneRequest
    from kgs.datasets.source import SceneSource


def check_size(size: int | str | None, downscale: float | None, is_unposed: bool) -> None:
    """Raise an ArgumentError unless photos can have this size."""
    if size is not None and downscale is not None:
        raise ArgumentError("size", "either a size or a downscale factor", "both")
    if isinstance(size, str) and re.fullmatch(r"field|images(_\d+)?", size) is None:
        raise ArgumentError("size", "pixels, field or a folder as images_8", quoted(size))
    if isinstance(size, str) and is_unposed:
        raise ArgumentError("size", "pixels for photos without camera poses", quoted(size))
    if isinstance(size, int):
        check_side(size)


def default_size(detail: str, preset: str, has_kgs_cameras: bool, is_on_cpu: bool) -> int | str | None:
    """The size where none is asked for: pixels of the longer side, "field", or None for the photos' own."""
    if detail != "normal" or (has_kgs_cameras and is_on_cpu):
        return DETAILS[detail].size
    return "field" if preset in ("paper", "plain") and not has_kgs_cameras else None


def with_size(request: "SceneRequest", source: "SceneSource", size: int | str | None) -> "SceneRequest":
    """The request for a posed scene, with photos of this size."""
    from kgs.datasets.field import field_size

    if size is None:
        return request
    if isinstance(size, int):
        return replace(request, downscale=max(1.0, max(source.photo_size()) / size))
    if size != "field":
        return replace(request, photo_folder=size)
    photo_folder, factor, why = field_size(source)
    say(why)
    return replace(request, photo_folder=photo_folder, downscale=factor)
