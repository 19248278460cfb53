"""What a command needs to load the scene of a fit again."""

import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from kgs._support.errors import DataError, quoted
from kgs._support.json_files import is_number
from kgs.datasets.options import MASK_MODES
from kgs.datasets.source import SceneSource

from .details import DETAILS

if TYPE_CHECKING:
    from kgs.datasets.scene import Scene

_LARGER = 1.1  # how many times as large photos must be to be worth a line


@dataclass(frozen=True)
class SceneRequest:
    """The arguments of `load_scene`, and how the page and the film show the scene.

    Args:
        scene: the folder of the scene; "." is the folder of the results itself.
        train_views: training views; None: all that are not held out.
        downscale: factor by which the photos are reduced, at least 1, or None.
        hold_out: every Nth photo is for testing; 0: none; None: what the scene's files say.
        background: "black" or "white".
        points: "none", or "model-points".
        photos: whether the page shows photos; all are loaded.
        roll: degrees by which page and film are turned clockwise.
        title: of the page; "": the name of the folder.
        photo_folder: name of the folder of photos, as "images_8"; "": that of the largest.
        masks: the folder of their masks; "": where the scene's files say, or `masks/`.
        mask_mode: what black in a mask means, "ignore" or "transparent".
        depths: the folder of depth maps; "": there are none.
    """

    scene: str
    train_views: int | None = None
    downscale: float | None = None
    hold_out: int | None = None
    background: str = "black"
    points: str = "none"
    photos: bool = True
    roll: float = 0.0
    title: str = ""
    photo_folder: str = ""
    masks: str = ""
    mask_mode: str = "ignore"
    depths: str = ""

    def load(self, base: Path, say: Callable[[str], None] | None = None, source: SceneSource | None = None) -> "Scene":
        """Load the scene.

        Args:
            base: the folder that a relative path starts from; of no use with `source`.
            say: gets the loader's notes.
            source: the folder of the scene where it is open already.
        """
        from kgs.datasets.load import load_scene

        scene = load_scene(
            source or base / self.scene,
            self.train_views,
            self.downscale,
            hold_out=self.hold_out,
            background=self.background,
            points=self.points,
            photo_folder=self.photo_folder,
            masks=base / self.masks if self.masks else None,
            mask_mode=self.mask_mode,
            depths=base / self.depths if self.depths else None,
        )
        if say is not None:
            for note in scene.notes:
                say(note)
        return scene

    def title_of(self, base: Path) -> str:
        """The title of the page: as asked for, else the name of the folder in plain words."""
        return self.title or in_plain_words((base / self.scene).resolve().name)

    def full_side(self, scene: "Scene") -> int | None:
        """The longer side in pixels with `--detail high`; None where the photos of the fit are about as large."""
        side = max(scene.train.images.shape[-2:])
        largest = min(DETAILS["high"].size, round(side * self.shrink(scene)))
        return largest if largest > _LARGER * side else None

    def shrink(self, scene: "Scene") -> float:
        """By what factor the photos of `scene` are smaller than the largest that its folder has."""
        factor = self.downscale or 1.0
        if self.photo_folder:
            factor *= max(SceneSource(scene.root).photo_size()) / max(scene.train.images.shape[-2:])
        return factor

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for config.json."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any], path: Path) -> Self:
        """The inverse of :meth:`to_dict`; a DataError about the file at `path` where an entry is wrong."""
        names = {entry.name for entry in fields(cls)}
        request = cls(**{"scene": "", **{name: value for name, value in values.items() if name in names}})
        for name, (expected, is_right) in _EXPECTED.items():
            value = getattr(request, name)
            if not is_right(value):
                got = quoted(value) if name in values else "none"
                raise DataError(path, f"request.{name}", expected, got)
        return replace(request, roll=float(request.roll))


def in_plain_words(name: str) -> str:
    """The name of a folder or file as a title: as "my castle" for "my_castle"."""
    return re.sub(r"[\s_-]+", " ", name).strip() or name


_EXPECTED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "scene": ("a path", lambda v: isinstance(v, str) and v != "" and "\0" not in v),
    "train_views": ("a whole number above 0 or null", lambda v: v is None or is_number(v, 1, whole=True)),
    "downscale": ("a number of at least 1 or null", lambda v: v is None or is_number(v, 1)),
    "hold_out": (
        "0, a whole number above 1 or null",
        lambda v: v is None or (is_number(v, 0, whole=True) and v != 1),
    ),
    "background": ("one of ['black', 'white']", lambda v: v in ("black", "white")),
    "points": ("one of ['none', 'model-points']", lambda v: v in ("none", "model-points")),
    "photos": ("true or false", lambda v: isinstance(v, bool)),
    "roll": ("a number", lambda v: is_number(v)),
    "title": ("a text", lambda v: isinstance(v, str)),
    "masks": ("a path or nothing", lambda v: isinstance(v, str) and "\0" not in v),
    "depths": ("a path or nothing", lambda v: isinstance(v, str) and "\0" not in v),
    "mask_mode": (f"one of {list(MASK_MODES)}", lambda v: v in MASK_MODES),
    "photo_folder": (
        "images, images_ and a number, or nothing",
        lambda v: isinstance(v, str) and re.fullmatch(r"(images(_\d+)?)?", v) is not None,
    ),
}
