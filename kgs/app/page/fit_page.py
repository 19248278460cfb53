"""The page of a fit, index.html: collects the content for :func:`kgs.app.page.write_page` from a fit and its files."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import DataError
from kgs._support.json_files import read_json
from kgs.app.console import each
from kgs.app.files.cameras import as_taken, shown
from kgs.app.files.reach import film_views
from kgs.app.scene_request import SceneRequest
from kgs.datasets.folders import CAMERAS_REPORT
from kgs.datasets.load import load_scene
from kgs.datasets.scene import Scene, Views
from kgs.datasets.source import SceneSource
from kgs.datasets.splits import select_evenly
from kgs.fit.decisions import Decisions
from kgs.fit.fit import Fit
from kgs.fit.measures import used_init
from kgs.fit.pruning import contributions, left_out
from kgs.geometry.cameras import joined
from kgs.metrics.outlines import doubt

from .content import PageContent, PagePhotos, PageSplat, PageText
from .figures import psnr_of_views
from .pictures import Picture, in_strip
from .write import write_page

PAGE = "index.html"
MAX_PICTURES = 6  # photos that are shown beside their renders
_SMALL_PIXELS = 192  # of the shorter side of a photo that becomes a thumbnail
_BORDER = 0.03  # of the shorter side of a photo: the band whose mean is the ground of the viewer


def write_fit_page(
    path: Path,
    title: str,
    fits: Mapping[str, Fit],  # of one scene, with metrics, by the name of the run; "" for a single one
    *,
    beside: Views | None = None,
    words: tuple[str, str] = ("training", "test"),  # what training and test views are called
    notes: Sequence[str] = (),
    remarks: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,  # the content of config.json
    report: Path | None = None,  # photos.json, if it is there and can be read
    photos: bool = True,  # whether the page shows photos, renders and their differences
    roll: float = 0.0,  # degrees by which all pictures are turned clockwise
    small: Views | None = None,  # some of the views with pixels, for the thumbnails; None: those of the scene
) -> str:
    """Write the page of one or more fits of a scene; the viewer shows the last of them.

    The views `beside` their renders need pixels, others do not. Unless given, they are up to `MAX_PICTURES` test views,
    or training views if there are no test views.

    Returns:
        What the viewer shows less than the model, in words; "" for nothing.
    """
    fit = list(fits.values())[-1]
    scene = fit.scene
    views, word = (scene.test, words[1]) if len(scene.test) else (scene.train, words[0])
    photographed = beside or views.select(spread(len(views), MAX_PICTURES))
    pictured = shown(photographed, roll) if photos else []
    count = sum(map(len, pictured))
    kind = "photos" if word == "photo" else f"{word} photos"
    parts = [*shown(scene.train, roll), *shown(scene.test, roll)]
    image_of = _kept_image if beside is None and not roll else _new_image
    thumbnailed = [] if not photos else parts if small is None else shown(small, roll)
    images = {name: image for part in thumbnailed for name, image in zip(part.names, part.images, strict=True)}
    names = list(images)
    with torch.no_grad():
        gaussians = fit.model()
    runs = {run: one.metrics for run, one in fits.items()}
    first_run = next(iter(runs.values()))
    found = dict[str, Any]()
    if report is not None and report.is_file():
        with suppress(DataError):
            found = read_json(report)
    content = PageContent(
        splat=PageSplat(
            gaussians,
            background=_ground(photographed, scene.background),
            options=fit.options,
            weights=lambda: contributions(fit.model, scene.train, fit.options, fit.backend),
            offset=scene.offset,
        ),
        photos=PagePhotos(
            cameras=joined(*(part.cameras for part in parts)),
            names=[*scene.train.names, *scene.test.names],
            parts=[words[0]] * len(scene.train) + [words[1]] * len(scene.test),
            path=film_views(fit, roll)[0].cameras,
            pictures=_pictures(pictured, fits, image_of),
            pictures_note=f"{count} of {len(views)} {kind}." if count < len(views) else f"The {kind}.",
            thumbnails={names[i]: images[names[i]] for i in in_strip(names)},
        ),
        text=PageText(
            title,
            runs=runs,
            notes=[*filter(None, (doubt(run.get("outlines") or {}) for run in runs.values())), *notes],
            remarks=[*(line for run in runs for line in _remarks(run, runs[run])), *remarks],
            settings=_settings(settings or {}, fit.metrics),
            report=_report_facts(found),
            left_out=left_out(Decisions.from_dict(first_run.get("decisions") or {})),
        ),
    )
    return write_page(path, content)


def load_small(source: SceneSource, scene: Scene, background: str) -> Views:
    """The photos of the strip of thumbnails, in a small size, of a scene that was loaded without its photos."""
    count = len(in_strip(scene.train.names))
    shrink = max(1.0, min(source.photo_size()) / _SMALL_PIXELS)
    return load_scene(source, count, shrink, hold_out=0, background=background).train


def write_own_page(
    folder: Path,
    out: Path,
    fit: Fit,
    request: SceneRequest,
    settings: Mapping[str, Any],
    remarks: Sequence[str] = (),
) -> None:
    """Write the page of a fit with metrics into a folder, whose files belong to `out`; see :func:`write_fit_page`."""
    full_side = request.full_side(fit.scene)
    side = max(fit.scene.train.images.shape[-2:])
    finer = f"The photos were fitted with {side} pixels on their longer side; kgs fit --detail high takes {full_side}."
    write_fit_page(
        folder / PAGE,
        request.title_of(out),
        {"": fit},
        remarks=[*remarks, *([finer] if full_side else [])],
        settings=settings,
        report=fit.scene.root / CAMERAS_REPORT,
        photos=request.photos,
        roll=request.roll,
    )


def _pictures(
    parts: Sequence[Views], fits: Mapping[str, Fit], image_of: Callable[[Fit, Views, int], Tensor]
) -> list[Picture]:
    """The photos of some views beside the images of each fit."""
    levels = {run: psnr_of_views(fit.metrics) for run, fit in fits.items()}
    pictures = []
    for views, i in each([(part, i) for part in parts for i in range(len(part))], "page", "view"):
        name = views.names[i]
        renders = {run: image_of(fit, views, i) for run, fit in fits.items()}
        values = [f"{run} {levels[run][name]:.2f} dB".strip() for run in fits if name in levels[run]]
        caption = f"{name}: {', '.join(values)}" if values else name
        pictures.append(Picture(name, views.images[i], renders, caption))
    return pictures


def _kept_image(fit: Fit, views: Views, index: int) -> Tensor:
    """What a fit shows of a view that is one of its own."""
    name = views.names[index]
    for own, renders in ((fit.scene.test, fit.test_renders), (fit.scene.train, fit.train_renders)):
        if name in own.names:
            i = own.names.index(name)
            return as_taken(own.as_photo(i, renders[i].image[0]), own, i)
    raise KeyError(name)


def _new_image(fit: Fit, views: Views, index: int) -> Tensor:
    """What a fit shows of any view."""
    return views.as_photo(index, views.render(index, fit.render)[0])


def _ground(views: Views, background: Tensor) -> Tensor:
    """The colour behind the splat in the viewer, `(3,)`: the mean of the photos' border instead of black.

    `background` itself if the photos have transparency, and so show a thing before it, or if it is not black.
    """
    if views.alphas is not None or not len(views) or bool(background.any()):
        return background
    height, width = views.images.shape[-2:]
    band = math.ceil(_BORDER * min(height, width))
    border = torch.ones(height, width, dtype=torch.bool)
    border[band : height - band, band : width - band] = False
    usable = torch.ones_like(border) if views.usable is None else views.usable.cpu().all(0)
    rows = border & usable if bool((border & usable).any()) else usable
    ground: Tensor = views.images.cpu()[:, :, rows].mean((0, 2)) if bool(rows.any()) else background
    return ground


def _settings(config: Mapping[str, Any], metrics: Mapping[str, Any]) -> dict[str, Any]:
    """The content of config.json in one dict, without the schedule.

    Where metrics.json says what was used in place of what was asked for, it is that.
    """
    rest = {name: value for name, value in config.items() if name not in ("request", "fit", "schedule")}
    values = {**config.get("request", {}), **config.get("fit", {}), **rest}
    with suppress(KeyError, TypeError):
        values["init"] = used_init(values["init"], metrics["init"]["kind"])
    if "backend" in values:
        values["backend"] = metrics.get("backend", values["backend"])
    return values


def _report_facts(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of photos.json, without hashes and settings; long lists become a range. Missing parts are skipped."""
    skipped = ("seed", "settings", "sha256", "masks_sha256", "versions")
    report = {name: value for name, value in content.items() if name not in skipped}
    photos = report.pop("photos", None)
    left_out = report.pop("left_out", None)
    matches = report.pop("matches", None)
    with suppress(AttributeError, KeyError, TypeError, ValueError):
        points = [photo["points"] for photo in photos.values()]
        report["points in a photo"] = f"{min(points)} to {max(points)}"
        report["blurred"] = [name for name, photo in photos.items() if photo["blurred"]]
    with suppress(AttributeError, TypeError):
        report |= {f"left out: {name}": why for name, why in left_out.items()}
    with suppress(AttributeError, KeyError, TypeError):
        report["time"] = f"{sum(report.pop('seconds').values()):.0f} s"
    with suppress(IndexError, TypeError, ValueError):
        counts = [row[2] for row in matches]
        report["matches of a pair"] = f"{min(counts)} to {max(counts)}"
    return report


def _remarks(run: str, metrics: Mapping[str, Any]) -> Iterator[str]:
    """Where training views cover the scene, what the PSNR is there, and how far the fit moved its training cameras."""
    covered = metrics.get("seen") or {}
    if covered.get("psnr") is not None and covered.get("psnr_rest") is not None:
        sentence = (
            f"{100 * covered['share']:.0f} % of the area of the held-out photos is covered by two or more training "
            f"views: PSNR {covered['psnr']:.2f} dB there, {covered['psnr_rest']:.2f} dB elsewhere."
        )
        yield f"{run}: {sentence}" if run else sentence
    if poses := metrics.get("poses"):
        mean = f"{poses['degrees']:.2f} degrees and {100 * poses['depths']:.2f} % of the median depth"
        largest = f"{poses['max_degrees']:.2f} degrees and {100 * poses['max_depths']:.2f} %"
        yield f"The fit moved the training cameras by {mean} in the mean, and by at most {largest}."


def spread(count: int, max_count: int) -> list[int]:
    """Indices of at most `max_count` of `count` items, spread evenly, with the first and the last one."""
    return select_evenly(count, min(count, max_count)) if count else []
