"""Writes the page: one HTML file that contains everything it needs and loads nothing from the network."""

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.app.files.film import path_near_plane
from kgs.camera import MARGIN
from kgs.json_files import write_whole
from kgs.types import Gaussians, RasterOptions
from kgs.version import __version__

from .cameras import are_training, viewer_scene
from .data import Packed, pack
from .figures import facts, measure_table, psnr_of_views, psnr_plot, verdict, without_folders
from .pictures import GAIN, Picture, encoded

MOST_BYTES = 8_000_000  # of a page
MOST_FILM_BYTES = 1_100_000  # 1.5 MB of the page, in base64
_PICTURE_BYTES = 3_000_000  # of all photos, renders and differences
_LAYOUT_BYTES = 8192  # reserved for the layout of the splat and for sizes in the text
_FILES = [
    "style.css",
    "viewer.css",
    "renderer.js",
    "viewer.js",
    "pictures.js",
    "splat.vert.glsl",
    "splat.frag.glsl",
    "screen.vert.glsl",
    "screen.frag.glsl",
]


def write_page(
    path: Path,
    title: str,
    gaussians: Gaussians,
    cameras: PinholeCamera,
    names: Sequence[str],
    parts: Sequence[str],
    *,
    near_plane: float,
    background: Tensor,
    antialiased: bool = False,
    pictures: Sequence[Picture] = (),
    pictures_note: str = "",
    film: bytes = b"",
    runs: Mapping[str, Mapping[str, Any]] | None = None,
    left_out: str = "",
    notes: Sequence[str] = (),
    remarks: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
    report: Mapping[str, Any] | None = None,
    weights: Callable[[], Tensor] | None = None,
    most_bytes: int = MOST_BYTES,
) -> str:
    """Write a page with a viewer of a splat, photos beside renders, measures and facts. The write is atomic.

    The viewer opens at one of the training cameras nearest the mean pose, see `viewer_scene`. File names are shown as
    they are given; in all other texts absolute paths are shortened to their last part. The splat is packed into the
    bytes that the rest of the page leaves, see :func:`kgs.app.page.data.pack`.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres.

    Args:
        path: the file to write.
        title: of the page.
        gaussians: with harmonics, or RGB.
        cameras: the cameras of the photos, C >= 1 of one image size.
        names: file names of the C photos.
        parts: what each photo was used for: "training", "test", or another word.
        near_plane: of the renderer, in world units. Beside the photos' cameras the viewer's is farther away, see
            :func:`kgs.app.files.film.path_near_plane`.
        background: colour behind the splat, `(3,)` in [0, 1].
        antialiased: draw the splat as with `RasterOptions.antialiased`.
        pictures: photos with renders, `kgs.app.page.Picture`.
        pictures_note: a sentence that says which photos these are.
        film: the content of an MP4 or WebM file; b"" for none. It is left out where it has more than `MOST_FILM_BYTES`,
            or where anything of the splat would have to be left out for it.
        runs: the content of metrics.json by the name of the run; "" if there is only one run.
        left_out: what the fit left out, and why.
        notes: sentences to show below the one that says how good the fit is.
        remarks: sentences to show below the table of measures.
        settings: the settings of the fit.
        report: facts about how the cameras were found.
        weights: returns the contribution of each Gaussian, `(N,)`. It is called if Gaussians must be left out.
        most_bytes: limit for the page.

    Returns:
        What the viewer shows less than the splat, in words, see :class:`kgs.app.page.data.Packed`; "" for nothing.

    Raises:
        ValueError: the page does not fit.
        OSError: the file cannot be written.
    """
    import jinja2
    from markupsafe import Markup

    runs = runs or {}
    scene = viewer_scene(cameras, names, parts, gaussians.means, psnr_of_views(list(runs.values())[-1]) if runs else {})
    width, height = scene["cameras"][0]["size"]
    first_run = next(iter(runs.values()), {})
    measures_head, measures = measure_table(runs)
    folder = resources.files("kgs.app.page")
    context: dict[str, Any] = {
        "title": without_folders(title),
        "summary": f"{len(gaussians)} Gaussians; {_counts(parts)} photos of {width} × {height} pixels.",
        "version": __version__,
        "aspect": f"{width} / {height}",
        "scene": scene,
        "verdict": verdict(runs),
        "notes": [without_folders(note) for note in notes],
        "remarks": [without_folders(remark) for remark in remarks],
        "measures_head": measures_head,
        "measures": measures,
        "plot": psnr_plot(runs),
        "pictures": encoded(pictures, _PICTURE_BYTES),
        "pictures_note": pictures_note,
        "difference_gain": GAIN,
        "cameras": _camera_facts(scene["cameras"], parts) | facts(report or {}),
        "costs": _costs(runs),
        "left_out": without_folders(left_out),
        "settings": facts(settings or {}),
        "versions": facts(first_run.get("versions") or {"kgs": __version__}),
        "files": {name: Markup(folder.joinpath(name).read_text(encoding="utf-8")) for name in _FILES},
    }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("kgs.app.page", "."), autoescape=True, trim_blocks=True
    )
    template = environment.get_template("page.html.jinja")
    viewer_settings = {
        "nearPlane": near_plane,
        "farNearPlane": path_near_plane(gaussians.means, _training_cameras(cameras, parts), near_plane),
        "lowPass": RasterOptions.eps2d,
        "antialiased": antialiased,
        "margin": MARGIN,
        "background": background.tolist(),
    }

    def page(splat: Mapping[str, Any], words: Mapping[str, str]) -> bytes:
        data = json.dumps({"scene": scene, "settings": viewer_settings, **splat}, separators=(",", ":"))
        html: str = template.render(**context, **words, data=Markup(data.replace("<", "\\u003c")))
        return html.encode(errors="backslashreplace")  # file names can contain bytes that are not UTF-8

    def packed_beside(film: str) -> Packed:
        context["film"] = film
        room = max(0, most_bytes - len(page({}, {})) - _LAYOUT_BYTES)
        return pack(gaussians, cameras, room * 3 // 4, weights, near_plane)  # base64 turns 3 bytes into 4

    has_film = 0 < len(film) <= MOST_FILM_BYTES
    kind = "mp4" if film[4:8] == b"ftyp" else "webm"
    packed = packed_beside(f"data:video/{kind};base64," + base64.b64encode(film).decode() if has_film else "")
    if has_film and packed.is_reduced:
        packed = packed_beside("")
    content = base64.b64encode(packed.content).decode()
    splat = {"layout": packed.layout, "content": content}
    words = {
        "reduced": packed.left_out,
        "scene_size": f"{packed.layout['count']} Gaussians in {_megabytes(len(content))}",
        "page_size": _megabytes(0),  # as many characters as the true size
    }
    words["page_size"] = _megabytes(len(page(splat, words)))
    write_whole(path, page(splat, words))
    return packed.left_out


def _training_cameras(cameras: PinholeCamera, parts: Sequence[str]) -> PinholeCamera:
    rows = torch.tensor(are_training(parts))
    values = (cameras.intrinsics, cameras.extrinsics, cameras.height, cameras.width)
    return PinholeCamera(*(value.cpu()[rows] for value in values))


def _counts(parts: Sequence[str]) -> str:
    """As "3 training and 2 test", or the number alone if all photos are of one kind."""
    words = list(dict.fromkeys(parts))
    if len(words) == 1:
        return str(len(parts))
    return " and ".join(f"{list(parts).count(word)} {word}" for word in words)


def _camera_facts(cameras: Sequence[Mapping[str, Any]], parts: Sequence[str]) -> dict[str, str]:
    """The number of cameras, the size of their photos and their focal lengths, as text."""
    focal = sorted(camera["focal"][0] for camera in cameras)
    span = f"{focal[0]:.1f}" if focal[-1] - focal[0] < 0.1 else f"{focal[0]:.1f} to {focal[-1]:.1f}"
    width, height = cameras[0]["size"]
    share = focal[len(focal) // 2] / max(width, height)
    return {
        "cameras": _counts(parts),
        "photo size": f"{width} × {height} pixels",
        "focal length": f"{span} pixels, {share:.2f} of the longer side",
    }


def _costs(runs: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Seconds, memory and backend of each run, as text."""
    found = dict[str, str]()
    for run, metrics in runs.items():
        prefix = f"{run}: " if run else ""
        if metrics.get("seconds") is not None:
            found[f"{prefix}training"] = f"{metrics['seconds']:.1f} s for {metrics.get('steps', '?')} steps"
        for stage, seconds in (metrics.get("stages") or {}).items():
            found[f"{prefix}{stage}"] = f"{seconds:.1f} s" if isinstance(seconds, int | float) else str(seconds)
        if metrics.get("peak_rss_mb"):
            found[f"{prefix}peak memory"] = f"{metrics['peak_rss_mb']} MiB"
        if metrics.get("backend"):
            found[f"{prefix}backend"] = str(metrics["backend"])
    return found


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.2f} MB"
