"""The size in which a standard download is compared in the literature, where it holds its photos in several sizes."""

from os import PathLike

from .source import SceneSource

_FOLDER = "images_8"  # of LLFF and of Mip-NeRF 360, with three to 24 views
_FACTOR = 8
_LARGE = 2000  # pixels: photos that were made for cameras of fewer have been reduced already
_BLENDER = 800  # pixels of the download's images, which are halved


def field_size(scene: str | PathLike[str] | SceneSource) -> tuple[str, float | None, str]:
    """Which photos of a scene are those of published tables with few views, and by how much they are to be reduced.

    LLFF and COLMAP scenes: an eighth of the photos that the cameras are for, in `images_8` or made from what is there.
    Blender scenes: 400 pixels. All others, and what is as small already: as it is.

    Args:
        scene: its folder, or that folder opened before.

    Returns:
        `photo_folder` and `downscale` for :func:`kgs.datasets.load_scene`, and a sentence about them.

    Raises:
        DataError: it is not a scene, or its files are missing or damaged.
    """
    source = SceneSource.of(scene)
    if (source.root / _FOLDER).is_dir() and source.has_sizes:
        return _FOLDER, None, f"photos of {_FOLDER}/, the size of published tables"
    width, height = source.photo_size()
    wanted = max(width, height)
    if source.layout == "Blender" and wanted == _BLENDER:
        wanted //= 2
    elif source.has_sizes:
        lens = source.frames().frames[0].intrinsics
        full = max(lens.width, lens.height)
        wanted = round(full / _FACTOR) if full >= _LARGE else wanted
    factor = max(width, height) / wanted
    if factor <= 1.05:
        return "", None, f"photos of {width}x{height}, as they are: published tables have no smaller ones"
    reduced = f"{round(width / factor)}x{round(height / factor)}"
    why = "by averages over areas; published tables use files that were made otherwise"
    return "", factor, f"photos of {width}x{height} reduced to {reduced}, the size of published tables, {why}"
