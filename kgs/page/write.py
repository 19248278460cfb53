"""The page itself: everything that it needs in one file, which asks for nothing else."""

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs import __version__
from kgs.io.json_files import write_whole
from kgs.types import Gaussians, RasterOptions

from .cameras import viewer_scene
from .data import pack
from .figures import facts, levels, measures, plot, shareable
from .pictures import GAIN, Picture, encoded

MOST_BYTES = 8_000_000
_PICTURES = 3_000_000  # bytes of all pictures
_FILES = ["style.css", "viewer.css", "renderer.js", "viewer.js", "pictures.js"]
_FILES += ["splat.vert.glsl", "splat.frag.glsl", "screen.vert.glsl", "screen.frag.glsl"]
_LAYOUT = 8192  # bytes of what describes the splat's columns, and of sizes


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
    pictures: Sequence[Picture] = (),
    pictures_note: str = "",
    runs: Mapping[str, Mapping[str, Any]] | None = None,
    left_out: str = "",
    notes: Sequence[str] = (),
    settings: Mapping[str, Any] | None = None,
    report: Mapping[str, Any] | None = None,
    weights: Callable[[], Tensor] | None = None,
    most_bytes: int = MOST_BYTES,
) -> str:
    """Write a page with a viewer of a splat, photos beside renders, measures and facts.

    It opens at the first camera. Names of files are shown as they are given; of absolute paths in all other texts only
    the last name is. The splat gets the bytes that the rest leaves, see :func:`kgs.page.data.pack`.

    Convention:
        World-to-camera extrinsics, OpenCV axes, pixels with integer centres.

    Args:
        path: the file to write; it appears whole or not at all.
        title: of the page.
        gaussians: with harmonics, or RGB.
        cameras: C >= 1 cameras of one size, those of the photos.
        names: of the C photos.
        parts: what each was used for: "training", "test", or another word.
        near_plane: of the renderer, in world units.
        background: behind the splat, `(3,)` in [0, 1].
        pictures: photos with renders, `kgs.page.Picture`.
        pictures_note: which photos these are.
        runs: what metrics.json holds, by the name of the run: "" where there is one.
        left_out: what the fit left out, and why.
        notes: sentences for the reader, below the measures.
        settings: numbers of the fit.
        report: what is known about how the cameras were found.
        weights: what each Gaussian contributes, `(N,)`; asked for where some have to go.
        most_bytes: of the page.

    Returns:
        What the limit of size cost, in words; "" for nothing.

    Raises:
        ValueError: the page does not fit.
        OSError: the file cannot be written.
    """
    import jinja2
    from markupsafe import Markup

    runs, scene = runs or {}, viewer_scene(cameras, names, parts, gaussians.means)
    first = next(iter(runs.values()), {})
    head, rows = measures(runs)
    shown = encoded(pictures, _PICTURES)
    context: dict[str, Any] = {
        "title": shareable(title),
        "summary": _summary(len(gaussians), parts, scene["cameras"][0]["size"]),
        "version": __version__,
        "size": scene["cameras"][0]["size"][::-1],
        "scene": scene,
        "levels": levels(runs),
        "nothing_held_out": bool(first.get("train")) and not first.get("test"),
        "notes": [shareable(note) for note in notes],
        "measures_head": head,
        "measures": rows,
        "plot": plot(runs),
        "pictures": shown,
        "pictures_note": pictures_note,
        "difference_gain": GAIN,
        "cameras": _cameras(scene["cameras"], parts) | facts(report or {}),
        "costs": _costs(runs),
        "left_out": shareable(left_out),
        "settings": facts(settings or {}),
        "versions": facts(first.get("versions") or {"kgs": __version__}),
    }
    environment = jinja2.Environment(loader=jinja2.PackageLoader("kgs.page", "."), autoescape=True, trim_blocks=True)
    folder = resources.files("kgs.page")
    context["files"] = {name: Markup(folder.joinpath(name).read_text(encoding="utf-8")) for name in _FILES}
    template = environment.get_template("page.html.jinja")
    rules = {"nearPlane": near_plane, "lowPass": RasterOptions.eps2d, "background": background.tolist()}

    def page(splat: Mapping[str, Any], words: Mapping[str, str]) -> bytes:
        data = json.dumps({"scene": scene, "settings": rules, **splat}, separators=(",", ":"))
        html: str = template.render(**context, **words, data=Markup(data.replace("<", "\\u003c")))
        return html.encode(errors="backslashreplace")  # names of files that are no UTF-8

    room = most_bytes - len(page({}, {})) - _LAYOUT
    packed = pack(gaussians, cameras, max(0, room) * 3 // 4, weights, near_plane)
    content = base64.b64encode(packed.content).decode()
    splat = {"layout": packed.layout, "content": content}
    words = {"scene_size": f"{packed.layout['count']} Gaussians in {_megabytes(len(content))}"}
    words |= {"left_out_here": packed.left_out, "page_size": "0.00 MB"}
    words["page_size"] = f"This page has {_megabytes(len(page(splat, words)))}"
    write_whole(path, page(splat, words))
    return packed.left_out


def _summary(count: int, parts: Sequence[str], size: Sequence[int]) -> str:
    return f"{count} Gaussians; {_counts(parts)} photos of {size[0]} × {size[1]} pixels."


def _counts(parts: Sequence[str]) -> str:
    words = list(dict.fromkeys(parts))
    return " and ".join(f"{list(parts).count(word)} {word}" for word in words) if len(words) > 1 else str(len(parts))


def _cameras(cameras: Sequence[Mapping[str, Any]], parts: Sequence[str]) -> dict[str, str]:
    focal = sorted(camera["focal"][0] for camera in cameras)
    span = f"{focal[0]:.1f}" if focal[-1] - focal[0] < 0.1 else f"{focal[0]:.1f} to {focal[-1]:.1f}"
    width, height = cameras[0]["size"]
    return {
        "cameras": _counts(parts),
        "picture size": f"{width} × {height} pixels",
        "focal length": f"{span} pixels, {focal[len(focal) // 2] / max(width, height):.2f} of the longer side",
    }


def _costs(runs: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    found = dict[str, str]()
    for run, metrics in runs.items():
        mark = f"{run}: " if run else ""
        if metrics.get("seconds") is not None:
            found[f"{mark}training"] = f"{metrics['seconds']:.1f} s for {metrics.get('steps', '?')} steps"
        for stage, seconds in (metrics.get("stages") or {}).items():
            found[mark + str(stage)] = f"{seconds:.1f} s" if isinstance(seconds, int | float) else str(seconds)
        if metrics.get("peak_rss_mb"):
            found[f"{mark}memory at most"] = f"{metrics['peak_rss_mb']} MiB"
        if metrics.get("backend"):
            found[f"{mark}backend"] = str(metrics["backend"])
    return found


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.2f} MB"
