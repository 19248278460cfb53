"""What a command is given to read: photos, a video, or a scene with camera poses; whose kind is found once."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

from kgs.datasets.folders import CAMERAS_REPORT, layout_of, no_scene, scene_nearby
from kgs.datasets.source import SceneSource

from .find import find_photos, find_video


@dataclass(frozen=True)
class Source:
    """A path and what is there: one of `scene`, `video` and `photos`."""

    path: Path
    scene: SceneSource | None = None
    video: Path | None = None
    photos: tuple[Path, ...] = ()

    @classmethod
    def open(cls, path: Path) -> Self:
        """A scene; or a video or a folder of unposed photos, which is no scene and has none right below or above it.

        Raises:
            DataError: it is none of these, or some photos cannot be read.
        """
        if layout := layout_of(path):
            return cls(path, scene=SceneSource(path, layout))
        if path.is_dir() and scene_nearby(path) is None:
            return cls.unposed(path)
        if video := find_video(path):
            return cls(path, video=video)
        raise no_scene(path)

    @classmethod
    def unposed(cls, path: Path) -> Self:
        """A video, or a folder with one or with photos, whatever else is there; DataError as of :meth:`open`."""
        if video := find_video(path):
            return cls(path, video=video)
        return cls(path, photos=tuple(find_photos(path)))

    @property
    def is_unposed(self) -> bool:
        """Whether its cameras are to be found."""
        return self.scene is None

    @property
    def has_kgs_cameras(self) -> bool:
        """Whether kgs finds the cameras, or found them: such a scene is fitted as the photos alone would be."""
        found = self.scene is not None and self.scene.layout == "COLMAP"
        return self.scene is None or (found and (self.path / CAMERAS_REPORT).is_file())
