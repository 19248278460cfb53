"""Unposed photos: `kgs fit` finds their cameras, and makes a scene of them in the folder of the results."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import ArgumentError
from kgs.app.console import each, say
from kgs.datasets.folders import CAMERAS_REPORT, VIDEO_SUFFIXES, layout_of, no_scene, scene_nearby
from kgs.datasets.source import SceneSource

if TYPE_CHECKING:
    from kgs.app.scene_request import SceneRequest


def open_scene(path: Path) -> SceneSource | None:
    """A scene; None: a video, or a folder of unposed photos, which is no scene and has none right below or above it.

    Raises:
        DataError: it is none of these.
    """
    if layout := layout_of(path):
        return SceneSource(path, layout)
    is_video = path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES
    if is_video or (path.is_dir() and scene_nearby(path) is None):
        return None
    raise no_scene(path)


def find_scene(
    photos: Path, out: Path, request: "SceneRequest", seed: int, size: int | None = None, frames: int | None = None
) -> "tuple[SceneRequest, SceneSource]":
    """Find the cameras of unposed photos; returns how to load the scene, and its folder.

    The folder is `out`, or one in it until the new fit takes the place of a former one: see `pose_photos`.

    Args:
        photos: the folder of the photos, or a video.
        out: that of the results, which gets `images`, `sparse/0` and `photos.json`.
        request: what the user asked for. No photo is held out unless it says so. Its `downscale` divides the photos as
            they came, that of the result the smaller copies in `images`.
        seed: of the solvers.
        size: longer side of the photos in the fit, in pixels.
        frames: the number of frames that are taken from a video.

    Raises:
        DataError: as of `pose_photos`.
    """
    from kgs.app.scene_request import in_plain_words
    from kgs.app.sfm import pose_photos
    from kgs.app.sfm.find import find_video

    video = find_video(photos)
    masks = Path(request.masks) if request.masks else None
    for note in notes_on_photos(photos, masks):
        say(note)
    with on_ctrl_c("the cameras were not found yet, and nothing was written"):
        report = pose_photos(photos, out, seed=seed, masks=masks, frames=frames, wait=True, bar=each, say=say)
    largest = max(report["size"])
    wanted = largest if size is None else size
    if request.downscale is not None:
        wanted = max(report["photo_size"]) / request.downscale
    if wanted > largest and max(report["photo_size"]) > largest:
        say(f"the photos are fitted at {largest} pixels, the size of kgs's copies of them")
    loaded_as = replace(
        request,
        scene=".",
        hold_out=request.hold_out or 0,
        downscale=max(1.0, largest / wanted),
        title=request.title or in_plain_words(video.stem if video else photos.resolve().name),
        masks="",  # they are beside the copies of the photos
    )
    return loaded_as, SceneSource(report["folder"])


def is_posed_by_kgs(source: SceneSource) -> bool:
    """Whether a scene is of photos whose cameras kgs found: it is fitted as the photos alone would be."""
    return source.layout == "COLMAP" and (source.root / CAMERAS_REPORT).is_file()


def check_frames(frames: int | None, photos: Path) -> None:
    """Raise an ArgumentError unless so many frames can be taken from a video."""
    from kgs.app.sfm.find import MIN_PHOTOS, find_video

    if frames is not None and frames < MIN_PHOTOS:
        raise ArgumentError("frames", f"at least {MIN_PHOTOS}", frames)
    if frames is not None and find_video(photos) is None:
        raise ArgumentError("frames", "a video to take them from", "photos")


def notes_on_photos(photos: Path, masks: Path | None) -> list[str]:
    """What is to be said about a folder of unposed photos, as :func:`kgs.app.sfm.find.notes_on`; nothing of a video."""
    from kgs.app.sfm.find import find_video, notes_on

    return [] if find_video(photos) else list(notes_on(photos, masks))


@contextmanager
def on_ctrl_c(remains: str) -> Iterator[None]:
    """Let Ctrl-C in this block say what remains of the work."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(remains) from stop
