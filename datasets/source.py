"""The folder of a scene, opened once: its layout, and what its files say.

Loads neither NumPy nor torch before the files are read, so that the command reports a wrong folder at once.
"""

from dataclasses import replace
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import DataError

from .folders import LAYOUTS, layout_of, no_scene, unused_files

if TYPE_CHECKING:
    from .frames import FrameSet


class SceneSource:
    """A scene's folder. Its files are read when frames are asked for, and once.

    Args:
        root: the folder.
        layout: as of :func:`kgs.datasets.folders.layout_of`; None: it is found.

    Raises:
        DataError: it is not a scene; the message says what it is instead, and what to do.
    """

    def __init__(self, root: str | PathLike[str], layout: str | None = None) -> None:
        self.root = Path(root)
        layout = layout or layout_of(self.root)
        if layout is None:
            raise no_scene(self.root)
        self.layout = layout
        self._frames: dict[str, FrameSet] = {}

    @classmethod
    def of(cls, scene: "str | PathLike[str] | SceneSource") -> "SceneSource":
        """The scene itself where it is open already."""
        return scene if isinstance(scene, SceneSource) else cls(scene)

    @property
    def has_sizes(self) -> bool:
        """Whether the layout can have its photos in several sizes, a folder for each."""
        return LAYOUTS[self.layout].has_sizes

    def photo_size(self, photo_folder: str = "") -> tuple[int, int]:
        """Width and height of the first photo, which are those of all or turned; errors as of :meth:`frames`."""
        frames = self.frames(photo_folder).frames
        if not frames:
            raise DataError(self.root, "", "posed images", "none")
        return frames[0].image.size

    def frames(self, photo_folder: str = "") -> "FrameSet":
        """What the files say, with the photos of the folder of this name, else of the largest.

        Raises:
            DataError: the files are missing, damaged or contradict each other, or the layout has its photos elsewhere.
        """
        if photo_folder not in self._frames:
            self._frames[photo_folder] = self._read(photo_folder)
        return self._frames[photo_folder]

    def _read(self, photo_folder: str) -> "FrameSet":
        if photo_folder and not self.has_sizes:
            expected = f"a scene with several folders of photos for {photo_folder}"
            raise DataError(self.root, "", expected, self.layout)
        reader = import_module(f"kgs.datasets.layouts.{self.layout.lower()}")
        frames: FrameSet = reader.load(self.root, *([photo_folder] if self.has_sizes else []))
        return replace(frames, notes=(*frames.notes, *unused_files(self.root, self.layout)))
