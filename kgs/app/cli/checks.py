"""Checks of options that need no torch: a command calls them first, because torch takes seconds to load."""

from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import ArgumentError, DataError, quoted
from kgs.datasets.folders import has_photos
from kgs.datasets.options import held_out_between_ends
from kgs.datasets.source import SceneSource

from .tools import check_installed

if TYPE_CHECKING:
    from kgs.app.sfm.source import Source

SMALLEST = 32  # pixels of the longer side of a fit's photos
_HEAD = 4096  # bytes, enough for the header of any splat


def check_roll(roll: float) -> None:
    """Raise a ValueError unless this is an angle by which pictures can be turned."""
    if not -360 <= roll <= 360:
        raise ArgumentError("roll", "degrees in [-360, 360]", roll)


def check_side(size: int) -> None:
    """Raise a ValueError unless photos can be fitted with so many pixels on their longer side."""
    if size < SMALLEST:
        raise ArgumentError("size", f"at least {SMALLEST} pixels", size)


def check_file(out: Path, ending: str, source: Path | None = None) -> None:
    """Raise a ValueError or DataError unless a command can write its result to this file, which is not `source`.

    A file that is there is replaced if kgs wrote it, and if it is none of the results of a fit.
    """
    from kgs.app.files.results import read_marker

    if out.suffix.lower() != ending:
        raise ArgumentError("out", f"a file that ends in {ending}", quoted(out))
    if out.is_dir():
        raise DataError(out, "", "a file", "a folder of this name")
    if source is not None and out.exists() and out.samefile(source):
        raise ArgumentError("out", f"another file than {str(source)!r}, which is read")
    if not out.absolute().parent.is_dir():
        raise DataError(out, "", "a folder to write it to", "none")
    if out.exists() and not _is_of_kgs(out):
        raise DataError(out, "", "a new file or one that kgs wrote", "another", advice="choose another name")
    results = read_marker(out.parent)
    if any(out.name in results.get(kind, []) for kind in ("fit", "scale")):
        raise DataError(out, "", "a new file", "one of the results in this folder", advice="choose another name")


def _is_of_kgs(path: Path) -> bool:
    """Whether a file begins as the splats and pages that kgs writes."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    is_splat = head.startswith(b"ply\n") and b"\ncomment kgs " in head
    return is_splat or b'<meta name="generator" content="made by kgs ' in head


def check_photos_of(source: SceneSource) -> None:
    """Raise a DataError unless a scene has at least one photo."""
    if not has_photos(source.root):
        raise DataError(source.root, "", "photos in images/, or where its files say", "camera poses alone")


def check_results(out: Path) -> None:
    """Raise a DataError unless this is the folder of the results of a fit; end what a kill left of a move there."""
    from kgs.app.files.fit_files import UNFINISHED, has_fit
    from kgs.app.files.results import complete

    complete(out)
    config = out / "config.json"
    if not config.exists() and has_fit(out / UNFINISHED):
        raise DataError(out, "", "a fit that is done", "one that is not", advice="kgs fit --resume goes on with it")
    if not config.exists():
        raise DataError(config, "", "this file in the folder of the results of kgs fit", "none")


def check_init(init: str, source: "Source", depths: Path | None) -> None:
    """Raise an ArgumentError unless a fit can begin with these initial points, which depth maps are of use for."""
    if init == "scene" and (source.scene is None or source.scene.layout != "Blender"):
        kind = "photos without camera poses" if source.scene is None else f"the layout {source.scene.layout}"
        raise ArgumentError("init", f"another one for {kind}", "'scene', Blender's points")
    if depths is not None and init != "dense":
        raise ArgumentError("depths", "none without the init 'dense'", depths)


def check_frames(frames: int | None, source: "Source") -> None:
    """Raise an ArgumentError unless so many frames can be taken from a video."""
    from kgs.app.sfm.find import MIN_PHOTOS

    if frames is not None and frames < MIN_PHOTOS:
        raise ArgumentError("frames", f"at least {MIN_PHOTOS}", frames)
    if frames is not None and source.video is None:
        raise ArgumentError("frames", "a video to take them from", "photos")


def check_photos(
    source: "Source",
    views: int | None = None,
    hold_out: int | None = None,
    size: int | str | None = None,
    downscale: float | None = None,
    frames: int | None = None,
    shortest: int = 1,
) -> None:
    """Check that a scene has photos; of unposed photos check the options before their cameras are found.

    Args:
        source: a scene, photos, or a video, of which only the largest number of frames is known.
        views: to train on.
        hold_out: every Nth photo is held out.
        size: longer side of the photos in the fit; it needs the photos' headers, as `downscale` does.
        downscale: factor by which the photos are reduced.
        frames: to be taken from a video.
        shortest: least pixels of the shorter side in the fit.
    """
    from kgs.app.sfm.find import MAX_FRAMES

    if source.scene is not None:
        check_photos_of(source.scene)
        return
    check_installed("pycolmap")
    if source.video is not None:
        _check_views(views, hold_out, MAX_FRAMES if frames is None else frames, "frames")
        return
    _check_views(views, hold_out, len(source.photos), "photos")
    if size is None and downscale is None:
        return

    from kgs.datasets.image_file import ImageFile

    width, height = min(ImageFile(path).size for path in source.photos)
    name = "size" if downscale is None else "downscale"
    factor = max(1.0, max(width, height) / size) if isinstance(size, int) else downscale or 1.0
    reduced = [max(1, round(side / factor)) for side in (width, height)]
    for side, minimum, pixels in (("longer", SMALLEST, max(reduced)), ("shorter", shortest, min(reduced))):
        if pixels < minimum:
            got = f"{reduced[0]}x{reduced[1]} of {width}x{height}"
            raise ArgumentError(name, f"{minimum} pixels or more of the {side} side", got)


def _check_views(views: int | None, hold_out: int | None, count: int, what: str) -> None:
    """Raise a ValueError for more training views than `count` photos leave whose cameras kgs finds."""
    maximum = count - len(held_out_between_ends(count - 2, hold_out)) if hold_out else count
    if views is not None and views > maximum:
        rest = f" of which {count - maximum} are held out" if hold_out else ""
        raise ArgumentError("views", f"at most {maximum} of {count} {what}{rest}", views)
