"""The file layouts that `load_scene` reads, one file each: from a folder to a `FrameSet`."""

from dataclasses import replace
from pathlib import Path

from kgs.datasets.folders import layout_of, unused_files, why_no_scene
from kgs.datasets.frames import FrameSet
from kgs.errors import DataError

from .blender import load_blender
from .colmap import load_colmap
from .llff import load_llff
from .nerfstudio import load_nerfstudio

_READERS = {"LLFF": load_llff, "COLMAP": load_colmap, "Blender": load_blender, "nerfstudio": load_nerfstudio}


def find_layout(root: Path) -> FrameSet:
    """What the files of a scene's folder say; DataError where it is not a scene: what it is instead, and what to do."""
    layout = layout_of(root)
    if layout is None:
        raise DataError(root, "", why_no_scene(root))
    frames = _READERS[layout](root)
    return replace(frames, notes=(*frames.notes, *unused_files(root)))
