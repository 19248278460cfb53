"""Checks of options that need no torch: a command calls them first, because torch takes seconds to load."""

from pathlib import Path

from kgs._support.errors import ArgumentError, DataError, quoted
from kgs.datasets.folders import has_photos
from kgs.datasets.options import held_out_between_ends
from kgs.datasets.source import SceneSource

SMALLEST = 32  # pixels of the longer side of a fit's photos


def check_roll(roll: float) -> None:
    """Raise a ValueError unless this is an angle by which pictures can be turned."""
    if not -360 <= roll <= 360:
        raise ArgumentError("roll", "degrees in [-360, 360]", roll)


def check_side(size: int) -> None:
    """Raise a ValueError unless photos can be fitted with so many pixels on their longer side."""
    if size < SMALLEST:
        raise ArgumentError("size", f"at least {SMALLEST} pixels", size)


def check_file(out: Path, ending: str, kind: str, source: Path | None = None) -> None:
    """Raise a ValueError or DataError unless a command can write its result to this file, which is not `source`.

    `kind` is that of :func:`kgs.app.files.publishing.replacing`.
    """
    from kgs.app.files.publishing import check_free

    if out.suffix.lower() != ending:
        raise ArgumentError("out", f"a file that ends in {ending}", quoted(out))
    if out.is_dir():
        raise DataError(out, "", "a file", "a folder of this name")
    if source is not None and out.exists() and out.samefile(source):
        raise ArgumentError("out", f"another file than {str(source)!r}, which is read")
    if not out.absolute().parent.is_dir():
        raise DataError(out, "", "a folder to write it to", "none")
    check_free(out.parent, kind, [out.name])


def check_photos_of(source: SceneSource) -> None:
    """Raise a DataError unless a scene has at least one photo."""
    if not has_photos(source.root):
        raise DataError(source.root, "", "photos in images/, or where its files say", "camera poses alone")


def check_results(out: Path) -> None:
    """Raise a DataError unless this is the folder of the results of a fit."""
    from kgs._support.json_files import read_json
    from kgs.app.files.locks import locked
    from kgs.app.files.publishing import UNFINISHED, complete
    from kgs.app.files.results_folder import has_fit

    complete(out)
    config = out / "config.json"
    if not config.exists() and has_fit(out / UNFINISHED):
        with locked(out):  # or it is at work
            raise DataError(out, "", "a fit that is done", "one that is not", advice="kgs fit --resume goes on with it")
    if not config.exists():
        raise DataError(config, "", "this file in the folder of the results of kgs fit", "none")
    read_json(config)


def check_photos(
    folder: Path,
    out: Path,
    views: int | None = None,
    hold_out: int | None = None,
    size: int | None = None,
    downscale: float | None = None,
    frames: int | None = None,
    shortest: int = 1,
) -> None:
    """Check a folder of unposed photos or a video, and the options about them, before their cameras are found.

    Args:
        folder: of the photos, or a video. Of a video only the largest number of frames is known.
        out: the folder for the results.
        views: to train on.
        hold_out: every Nth photo is held out.
        size: longer side of the photos in the fit; it needs the photos' headers, as `downscale` does.
        downscale: factor by which the photos are reduced.
        frames: to be taken from a video.
        shortest: least pixels of the shorter side in the fit.
    """
    from kgs.app.sfm.find import MAX_FRAMES, find_photos, find_video
    from kgs.app.sfm.workspace import check_workspace

    if find_video(folder):
        _check_views(views, hold_out, MAX_FRAMES if frames is None else frames, "frames")
        return
    paths = find_photos(folder)
    check_workspace(out, paths)
    _check_views(views, hold_out, len(paths), "photos")
    if size is None and downscale is None:
        return

    from kgs.datasets.image_file import ImageFile

    width, height = min(ImageFile(path).size for path in paths)
    name = "size" if downscale is None else "downscale"
    factor = max(1.0, max(width, height) / size) if size is not None else downscale or 1.0
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
