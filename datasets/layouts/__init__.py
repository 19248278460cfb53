"""The file layouts that `load_scene` reads, one file each: from a folder to a `FrameSet`."""

from collections.abc import Callable

from kgs.datasets.frames import FrameSet

from .blender import load_blender
from .colmap import load_colmap
from .llff import load_llff
from .nerfstudio import load_nerfstudio

READERS: dict[str, Callable[..., FrameSet]] = {
    "LLFF": load_llff,
    "COLMAP": load_colmap,
    "Blender": load_blender,
    "nerfstudio": load_nerfstudio,
}
