"""The page of a fit, index.html: what the fit knows, for :mod:`kgs.page`."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.datasets.layouts import CAMERAS_REPORT
from kgs.datasets.scene import Scene, Views
from kgs.datasets.splits import select_evenly
from kgs.errors import DataError
from kgs.fit.prune import contributions, left_out
from kgs.fit.run import Finished
from kgs.fit.saved import SavedFit
from kgs.io.console import each, say
from kgs.io.json_files import read_json
from kgs.io.outputs import is_own
from kgs.model import GaussianModel

from . import Picture, write_page

PAGE = "index.html"
MOST_PICTURES = 6

Render = Callable[[PinholeCamera], Tensor]


def write_fit_page(
    path: Path,
    title: str,
    scene: Scene,
    model: GaussianModel,
    near_plane: float,
    renders: Mapping[str, Render],
    runs: Mapping[str, Mapping[str, Any]],
    *,
    shown: Views | None = None,
    words: tuple[str, str] = ("training", "test"),
    notes: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
    report: Path | None = None,
) -> str:
    """Write the page of one or more fits of a scene; the viewer shows one of them.

    Args:
        path: of the page.
        title: of the page.
        scene: photos and cameras.
        model: what the viewer shows.
        near_plane: of its renderer.
        renders: from a camera to `(1, 3, H, W)`, by the name of the run.
        runs: what metrics.json holds, by the name of the run.
        shown: some of the test views, or without those of the training views; None: `MOST_PICTURES` of them. Only
            these need pixels.
        words: what training and test views are called.
        notes: sentences for the reader.
        settings: config.json.
        report: a JSON file about how the cameras were found; left aside where it is not there.

    Returns:
        What the page's limit of size cost, in words; "" for nothing.
    """
    views, word = (scene.test, words[1]) if len(scene.test) else (scene.train, words[0])
    shown = shown or views.select(spread(len(views), MOST_PICTURES))
    known = {run: _levels(metrics) for run, metrics in runs.items()}
    pictures = list[Picture]()
    for i in each(range(len(shown)), "page", "view"):
        name, camera = shown.names[i], shown.camera(i)
        level = [f"{run} {known[run][name]:.2f} dB".strip() for run in renders if name in known.get(run, {})]
        seen = {run: shown.as_photo(draw(camera)[0]) for run, draw in renders.items()}
        pictures.append(Picture(name, shown.images[i], seen, ": ".join([name, *([", ".join(level)] if level else [])])))
    found: dict[str, Any] = {}
    with suppress(DataError):
        found = read_json(report) if report is not None and report.is_file() else {}
    with torch.no_grad():
        gaussians = model()
    return write_page(
        path,
        title,
        gaussians,
        _all_cameras(scene.train, scene.test),
        [*scene.train.names, *scene.test.names],
        [words[0]] * len(scene.train) + [words[1]] * len(scene.test),
        near_plane=near_plane,
        background=scene.background,
        pictures=pictures,
        pictures_note=_note(len(shown), len(views), word),
        runs=runs,
        left_out=left_out(next(iter(runs.values()), {}).get("needs") or {}),
        notes=[*notes, *(line for run, metrics in runs.items() for line in (*_seen(metrics, run), *_moved(metrics)))],
        settings=_settings(settings or {}),
        report=_report(found),
        weights=lambda: contributions(model, scene.train, near_plane),
    )


def write_own_page(fit: Finished) -> None:
    """Write the page of a fit into its folder, see `before_publish` of :func:`kgs.fit.fit_scene`."""
    trainer = fit.trainer
    _write_page_of(
        fit.folder / PAGE,
        fit.out,
        trainer.scene,
        trainer.shown,
        trainer.near_plane,
        trainer.render,
        fit.metrics,
        fit.settings,
    )


def _write_page_of(
    path: Path,
    out: Path,
    scene: Scene,
    model: GaussianModel,
    near_plane: float,
    render: Render,
    metrics: Mapping[str, Any],
    settings: Mapping[str, Any],
) -> None:
    """Write the page of the one fit that `out` is the folder of, as :func:`write_fit_page`."""
    request = settings["request"]
    title = request.get("title") or (out / request.get("scene", scene.root)).resolve().name
    report = scene.root / CAMERAS_REPORT
    write_fit_page(path, title, scene, model, near_plane, {"": render}, {"": metrics}, settings=settings, report=report)


def refresh_page(out: Path, saved: SavedFit, scene: Scene, metrics: Mapping[str, Any]) -> None:
    """Write the page of a fit that is in a folder again, with other measures; not in place of a user's own file."""
    path = out / PAGE
    if path.exists() and not is_own(path):
        say(f"{path} was not written by kgs, and is left as it is")
        return

    def render(camera: PinholeCamera) -> Tensor:
        return saved.render(camera, scene.background)

    settings = read_json(out / "config.json")
    _write_page_of(path, out, saved.placed(scene), saved.model, saved.near_plane, render, metrics, settings)


def _settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """What config.json says, without the steps at which things happened."""
    parts = {name: value for name, value in config.items() if name != "timetable"}
    return {**parts.pop("request", {}), **parts.pop("fit", {}), **parts}


def _report(found: Mapping[str, Any]) -> dict[str, Any]:
    """What photos.json says of the cameras, without hashes and settings, its lists in a number or two."""
    report = {name: value for name, value in found.items() if name not in ("seed", "settings", "sha256", "versions")}
    photos, matches = report.pop("photos", None), report.pop("matches", None)
    with suppress(AttributeError, KeyError, TypeError, ValueError):
        points = [photo["points"] for photo in photos.values()]
        report["points in a photo"] = f"{min(points)} to {max(points)}"
        report["blurred"] = [name for name, photo in photos.items() if photo["blurred"]]
    with suppress(AttributeError, KeyError, TypeError):
        report["time"] = f"{sum(report.pop('seconds').values()):.0f} s"
    with suppress(IndexError, TypeError, ValueError):
        counts = [row[2] for row in matches]
        report["matches of a pair"] = f"{min(counts)} to {max(counts)}"
    return report


def _note(shown: int, count: int, word: str) -> str:
    photos = f"{word} photos".removeprefix("photo ")
    return f"{shown} of {count} {photos}." if shown < count else f"The {photos}."


def _seen(metrics: Mapping[str, Any], run: str) -> list[str]:
    """How good held-out views are where training views show the scene, in words."""
    seen = metrics.get("seen") or {}
    if seen.get("psnr") is None or seen.get("psnr_rest") is None:
        return []
    share, level = f"{100 * seen['share']:.0f} %", f"{seen['psnr']:.2f} dB there, {seen['psnr_rest']:.2f} dB elsewhere"
    sentence = f"two training views or more show {share} of what the held-out photos do: PSNR {level}."
    sentence = f"{run}: {sentence}" if run else sentence
    return [sentence[0].upper() + sentence[1:]]


def _moved(metrics: Mapping[str, Any]) -> list[str]:
    """How far a fit moved its training cameras, in words."""
    if (found := metrics.get("poses")) is None:
        return []
    turned, shifted = f"{found['degrees']:.2f} degrees", f"{100 * found['depths']:.2f} % of the median depth"
    most = f"at most {found['most_degrees']:.2f} degrees and {100 * found['most_depths']:.2f} %"
    return [f"The fit moved the training cameras by {turned} and {shifted} in the mean, {most}."]


def _levels(metrics: Mapping[str, Any]) -> dict[str, float]:
    """The PSNR of each view that was measured and has one."""
    parts = [metrics.get(part) or {} for part in ("test", "train", "views")]
    return {row["name"]: row["psnr"] for part in parts for row in part.get("views", []) if row["psnr"] is not None}


def _all_cameras(*parts: Views) -> PinholeCamera:
    names = ("intrinsics", "extrinsics", "height", "width")
    return PinholeCamera(*(torch.cat([getattr(views.cameras, name) for views in parts]) for name in names))


def spread(count: int, most: int) -> list[int]:
    """At most so many of the positions, spread evenly, the first and the last among them."""
    return select_evenly(count, min(count, most)) if count else []
