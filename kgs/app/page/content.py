"""What a page shows, in the three parts that :func:`kgs.app.page.write_page` takes together."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.geometry.types import Gaussians, RasterOptions

from .pictures import Picture


@dataclass(frozen=True, eq=False)
class PageSplat:
    """The splat in the viewer.

    The viewer follows the options `near_plane` and `antialiased`; away from the photos' cameras its near plane is
    farther away, see :func:`kgs.app.files.film.path_near_plane`.
    """

    gaussians: Gaussians  # with harmonics, or RGB
    background: Tensor  # colour behind the splat, `(3,)` in [0, 1]
    options: RasterOptions = field(default_factory=RasterOptions)
    weights: Callable[[], Tensor] | None = None  # see :func:`kgs.app.page.data.pack`
    offset: Tensor | None = None  # of the Scene, `(3,)`: the page says where points are in the splat's file; None: zero


@dataclass(frozen=True, eq=False)
class PagePhotos:
    """The photos of the scene: their cameras, and those that are shown beside their renders."""

    cameras: PinholeCamera  # of the photos, C >= 1; OpenCV axes, integer pixel centres
    names: Sequence[str]  # file names of the C photos
    parts: Sequence[str]  # what each photo was used for: "training", "test", or another word
    pictures: Sequence[Picture] = ()
    pictures_note: str = ""  # a sentence that says which photos these are
    # some of the photos, RGB `(3, H, W)`, by their names; a click on one flies to its camera. Without any: numbers
    thumbnails: Mapping[str, Tensor] = field(default_factory=dict)
    path: PinholeCamera | None = None  # the film's cameras, whose arc is the viewer's; None: the training cameras


@dataclass(frozen=True)
class PageText:
    """Words and numbers. Absolute paths in them are shortened to their last part."""

    title: str
    runs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # metrics.json by the name of the run, see Runs
    notes: Sequence[str] = ()  # sentences below the one that says how good the fit is
    remarks: Sequence[str] = ()  # sentences below the table of measures
    settings: Mapping[str, Any] = field(default_factory=dict)  # of the fit
    report: Mapping[str, Any] = field(default_factory=dict)  # how the cameras were found
    left_out: str = ""  # what the fit does without, and why


@dataclass(frozen=True, eq=False)
class PageContent:
    """All that a page shows."""

    splat: PageSplat
    photos: PagePhotos
    text: PageText
