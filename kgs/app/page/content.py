"""What a page shows, in the four parts that :func:`kgs.app.page.write_page` takes together."""

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

    Args:
        gaussians: with harmonics, or RGB.
        background: colour behind the splat, `(3,)` in [0, 1].
        options: of the renderer. The viewer follows `near_plane` and `antialiased`; away from the photos' cameras its
            near plane is farther away, see :func:`kgs.app.files.film.path_near_plane`.
        weights: returns the contribution of each Gaussian, `(N,)`; called only if Gaussians must be left out, those
            that contribute least first. None: opacity times area.
        offset: the origin of the Gaussians' frame in the coordinates of the splat's file, `(3,)`, in which the page
            says where points are: the `offset` of a Scene. None: zero.
    """

    gaussians: Gaussians
    background: Tensor
    options: RasterOptions = field(default_factory=RasterOptions)
    weights: Callable[[], Tensor] | None = None
    offset: Tensor | None = None


@dataclass(frozen=True, eq=False)
class PagePhotos:
    """The photos of the scene: their cameras, and those that are shown beside their renders.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres.

    Args:
        cameras: the cameras of the photos, C >= 1.
        names: file names of the C photos.
        parts: what each photo was used for: "training", "test", or another word.
        pictures: some of the photos with their renders.
        pictures_note: a sentence that says which photos these are.
        thumbnails: some of the photos, RGB in [0, 1], `(3, H, W)`, by their names; a click on one flies to its camera.
            Without any there are numbers instead.
    """

    cameras: PinholeCamera
    names: Sequence[str]
    parts: Sequence[str]
    pictures: Sequence[Picture] = ()
    pictures_note: str = ""
    thumbnails: Mapping[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True)
class PageText:
    """Words and numbers. Absolute paths in them are shortened to their last part.

    Args:
        title: of the page.
        runs: the content of metrics.json by the name of the run; "" if there is only one run.
        notes: sentences below the one that says how good the fit is.
        remarks: sentences below the table of measures.
        settings: the settings of the fit.
        report: facts about how the cameras were found.
        left_out: what the fit left out, and why.
    """

    title: str
    runs: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    notes: Sequence[str] = ()
    remarks: Sequence[str] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    report: Mapping[str, Any] = field(default_factory=dict)
    left_out: str = ""


@dataclass(frozen=True, eq=False)
class PageContent:
    """All that a page shows.

    Args:
        splat: the splat in the viewer.
        photos: the photos and their cameras.
        text: title, measures, notes and settings.
    """

    splat: PageSplat
    photos: PagePhotos
    text: PageText
