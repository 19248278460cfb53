"""The file layouts that `load_scene` reads, one file each: from a folder to a `FrameSet`."""

from dataclasses import replace
from pathlib import Path

from kgs._support.errors import DataError
from kgs.datasets.folders import layout_of, unused_files, why_no_scene
from kgs.datasets.frames import FrameSet

from .blender import load_blender
from .colmap import load_colmap
from .llff import load_llff
from .nerfstudio import load_nerfstudio

_READERS = {"Blender": load_blender, "nerfstudio": load_nerfstudio}
_READERS_OF_FOLDERS = {"LLFF": load_llff, "COLMAP": load_colmap}  # these have the same photos in several sizes


def find_layout(root: Path, photo_folder: str = "") -> FrameSet:
    """What the files of a scene's folder say, with the photos of the folder of this name, else of the largest.

    Raises:
        DataError: it is not a scene; the message says what it is instead, and what to do. Or the layout has its photos
            elsewhere.
    """
    layout = layout_of(root)
    if layout is None:
        raise DataError(root, "", why_no_scene(root))
    if layout in _READERS_OF_FOLDERS:
        frames = _READERS_OF_FOLDERS[layout](root, photo_folder)
    elif photo_folder:
        raise DataError(root, "", f"expected a scene with several folders of photos for {photo_folder}, got {layout}")
    else:
        frames = _READERS[layout](root)
    return replace(frames, notes=(*frames.notes, *unused_files(root)))
