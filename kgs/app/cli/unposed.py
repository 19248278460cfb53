"""Unposed photos: `kgs fit` finds their cameras, and makes a scene of them in the folder of the results."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kgs.app.console import say
from kgs.datasets.source import SceneSource

if TYPE_CHECKING:
    from kgs.app.files.results import Results
    from kgs.app.scene_request import SceneRequest
    from kgs.app.sfm.source import Source


def find_scene(
    source: "Source",
    results: "Results",
    request: "SceneRequest",
    seed: int,
    size: int | None = None,
    frames: int | None = None,
) -> "tuple[SceneRequest, SceneSource]":
    """Find the cameras of unposed photos; returns how to load the scene, and its folder.

    The folder is that of the results, or one in it until the new fit takes the place of a former one.

    Args:
        source: the photos, or a video.
        results: the folder of the results, which gets `images`, `sparse/0` and `photos.json`.
        request: what the user asked for. No photo is held out unless it says so. Its `downscale` divides the photos as
            they came, that of the result the smaller copies in `images`.
        seed: of the solvers.
        size: longer side of the photos in the fit, in pixels.
        frames: the number of frames that are taken from a video.

    Raises:
        DataError: as of :func:`kgs.app.sfm.pose.pose`.
    """
    from kgs.app.scene_request import in_plain_words
    from kgs.app.sfm import pose
    from kgs.datasets.depths import find_depths

    if request.depths:  # an error now, not once there are cameras, about the names of the copies
        find_depths([path.with_suffix(".png") for path in source.photos], Path(request.depths))
    masks = Path(request.masks) if request.masks else None
    with on_ctrl_c("the cameras were not found yet, and nothing was written"):
        report = pose.pose(source, results, seed=seed, masks=masks, frames=frames, for_fit=True)
    largest = max(report["size"])
    wanted = largest if size is None else size
    if request.downscale is not None:
        wanted = max(report["photo_size"]) / request.downscale
    if wanted > largest and max(report["photo_size"]) > largest:
        say(f"the photos are fitted at {largest} pixels, the size of kgs's copies of them")
    name = source.video.stem if source.video else source.path.resolve().name
    loaded_as = replace(
        request,
        scene=".",
        hold_out=request.hold_out or 0,
        downscale=max(1.0, largest / wanted),
        title=request.title or in_plain_words(name),
        masks="",  # they are beside the copies of the photos
    )
    return loaded_as, SceneSource(report["folder"])


@contextmanager
def on_ctrl_c(remains: str) -> Iterator[None]:
    """Let Ctrl-C in this block say what remains of the work."""
    try:
        yield
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(remains) from stop
