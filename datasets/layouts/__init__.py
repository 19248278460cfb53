"""The layouts of scenes that `load_scene` reads: an entry of `LAYOUTS` each, and a file with its reader, `load`."""

from typing import NamedTuple


class Layout(NamedTuple):
    """How the files of a scene lie in its folder."""

    file: str = ""  # says where the cameras are; "": a COLMAP model does
    has_sizes: bool = False  # the same photos may be there in several sizes, a folder for each


# In the order in which they are looked for. The reader of layout X is in the file x.py.
LAYOUTS = {
    "LLFF": Layout("poses_bounds.npy", has_sizes=True),
    "COLMAP": Layout(has_sizes=True),
    "Blender": Layout("transforms_train.json"),
    "nerfstudio": Layout("transforms.json"),
}
POSE_FILES = tuple(layout.file for layout in LAYOUTS.values() if layout.file)
