"""Writes the page: one HTML file that contains everything it needs and loads nothing from the network."""

import base64
import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from kgs._support.json_files import write_whole
from kgs._support.version import __version__
from kgs.app.files.film import path_near_plane
from kgs.app.files.plot import psnr_plot
from kgs.geometry.lenses import MARGIN
from kgs.geometry.types import RasterOptions

from .cameras import training_cameras, viewer_scene
from .content import PageContent, PagePhotos, PageSplat, PageText
from .data import Packed, pack
from .figures import facts, measure_table, psnr_of_views, verdict, without_folders
from .pictures import GAIN, encoded, in_strip, thumbnails

MAX_BYTES = 8_000_000  # of a page
_PICTURE_BYTES = 3_000_000  # of all photos, renders and differences
_THUMBNAIL_BYTES = 100_000  # of all thumbnails
_LAYOUT_BYTES = 8192  # reserved for the layout of the splat and for sizes in the text
_NUMBERS = ("One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten", "Eleven", "Twelve")
_OPTION = re.compile(r"--[a-z][a-z-]*")  # of a command, in a sentence
_LISTED = 24  # photos whose file names are under Details
_STYLES = ("style.css", "viewer.css")
_SCRIPTS = ("renderer.js", "ruler.js", "viewer.js", "pictures.js")
_SHADERS = ("splat.vert.glsl", "splat.frag.glsl", "screen.vert.glsl", "screen.frag.glsl")


def write_page(path: Path, content: PageContent, max_bytes: int = MAX_BYTES) -> str:
    """Write a page with a viewer of a splat, photos beside renders, measures and facts. The write is atomic.

    The viewer opens at one of the training cameras nearest the mean pose, see `viewer_scene`. File names are shown as
    they are given. The splat is packed into the bytes that the rest of the page leaves, see
    :func:`kgs.app.page.data.pack`.

    Returns:
        What the viewer shows less than the splat, in words, see :class:`kgs.app.page.data.Packed`; "" for nothing.

    Raises:
        ValueError: the page does not fit.
        OSError: the file cannot be written.
    """
    page = _Page(content)
    splat = content.splat
    room = max(0, max_bytes - len(page.html()) - _LAYOUT_BYTES)
    packed = pack(
        splat.gaussians,
        content.photos.cameras,
        room * 3 // 4,  # base64 turns 3 bytes into 4
        splat.weights,
        splat.options.near_plane,
    )
    size = len(page.html(packed))
    write_whole(path, page.html(packed, size))
    return packed.reduced


class _Page:
    """Makes the HTML of a page, first without its splat, which is packed into what the rest leaves.

    Its policy (CSP) names the one script and the one style sheet by their SHA-256. The browser runs and applies no
    other, should a text of the user ever get into the page as code; so elements have no style attributes.
    """

    def __init__(self, content: PageContent) -> None:
        import jinja2
        from markupsafe import Markup

        runs = list(content.text.runs.values())
        scene = viewer_scene(
            content.photos.cameras,
            content.photos.names,
            content.photos.parts,
            content.splat.gaussians.means,
            psnr_of_views(runs[-1]) if runs else {},
            content.photos.path,
        )
        offset = content.splat.offset
        self._scene = scene | {"offset": [0.0, 0.0, 0.0] if offset is None else offset.tolist()}
        self._settings = _viewer_settings(content.splat, content.photos)
        self._context = _context(content, self._scene)
        width, height = scene["cameras"][scene["first"]]["size"]
        sizes = [f":root {{ --aspect: {width} / {height} }}\n"]
        for one in self._context["strip"]:
            if "photo" in one:
                size = f"--width: {one['width']}; --height: {one['height']}"
                sizes.append(f'[data-camera="{one["index"]}"] {{ {size} }}\n')
        code = {
            "style": "".join([*map(_file, _STYLES), *sizes]),
            "script": "".join(map(_file, _SCRIPTS)),
        }
        for kind, text in code.items():
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            self._context |= {kind: Markup(text), f"{kind}_hash": f"sha256-{digest}"}
        loader = jinja2.PackageLoader("kgs.app.page", ".")
        environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True)
        environment.filters["options_whole"] = _options_whole
        self._template = environment.get_template("page.html.jinja")

    def html(self, packed: Packed | None = None, page_bytes: int = 0) -> bytes:
        """The whole file, which says that it has `page_bytes`: the text is equally long for all sizes below 10 MB."""
        from markupsafe import Markup

        splat = {}
        words = {}
        if packed is not None:
            content = base64.b64encode(packed.content).decode()
            splat = {"layout": packed.layout, "content": content}
            words = {
                "reduced": packed.reduced,
                "scene_size": f"{packed.layout['count']} Gaussians in {_megabytes(len(content))}",
                "page_size": _megabytes(page_bytes),
            }
        data = {"scene": self._scene, "settings": self._settings, **splat}
        text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
        html: str = self._template.render(**self._context, **words, data=Markup(text))
        return html.encode(errors="backslashreplace")  # file names can contain bytes that are not UTF-8


def _context(content: PageContent, scene: Mapping[str, Any]) -> dict[str, Any]:
    """What the template shows besides the splat; `scene` is that of :func:`viewer_scene`."""
    from markupsafe import Markup

    photos = content.photos
    text = content.text
    cameras = scene["cameras"]
    first_run = next(iter(text.runs.values()), {})
    measures_head, measures = measure_table(text.runs)
    return {
        "title": text.title,
        "lead": f"{_counted([camera['part'] == 'test' for camera in cameras])} Drag to look around.",
        "strip": _strip(photos, cameras),
        "has_photos": bool(photos.pictures or photos.thumbnails),
        "version": __version__,
        "scene": scene,
        "verdict": verdict(text.runs),
        "notes": [without_folders(note) for note in text.notes],
        "remarks": [without_folders(remark) for remark in text.remarks],
        "measures_head": measures_head,
        "measures": measures,
        "plot": psnr_plot(text.runs),
        "pictures": encoded(photos.pictures, _PICTURE_BYTES),
        "pictures_note": photos.pictures_note,
        "difference_gain": GAIN,
        "cameras": {**_camera_facts(cameras, photos.parts), **facts(text.report)},
        "costs": _costs(text),
        "left_out": without_folders(text.left_out),
        "settings": facts(text.settings),
        "versions": facts(first_run.get("versions") or {"kgs": __version__}),
        "files": {name: Markup(_file(name)) for name in _SHADERS},
    }


def _counted(held_out: Sequence[bool]) -> str:
    """How many photos there are, and how many more were held out, if they are not all."""
    more = sum(held_out) % len(held_out)
    used = len(held_out) - more
    number, other = (_NUMBERS[count - 1] if 0 < count <= len(_NUMBERS) else str(count) for count in (used, more))
    return f"{number} photo{'s' if used > 1 else ''}{f', {other.lower()} more held out' if more else ''}."


def _options_whole(text: str) -> str:
    """A sentence as HTML, in which no line ends inside an option of a command."""
    from markupsafe import Markup, escape

    return Markup(_OPTION.sub(r'<span class="option">\g<0></span>', str(escape(text))))


def _file(name: str) -> str:
    """The text of a file of this folder."""
    return resources.files("kgs.app.page").joinpath(name).read_text(encoding="utf-8")


def _strip(photos: PagePhotos, cameras: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The photos to fly to, in the order of names: index of the camera, label, number, and thumbnail if any."""
    names = [camera["name"] for camera in cameras]
    small = photos.thumbnails
    shown = [i for i, name in enumerate(names) if not small or name in small]
    chosen = [shown[k] for k in in_strip([names[i] for i in shown])]
    pictures = thumbnails([small[names[i]] for i in chosen], _THUMBNAIL_BYTES) if small else [{} for _ in chosen]
    numbers = {name: number for number, name in enumerate(sorted(names), 1)}
    return [
        {
            "index": i,
            "label": cameras[i]["label"],
            "number": numbers[names[i]],
            "held_out": cameras[i]["part"] == "test",
            **picture,
        }
        for i, picture in zip(chosen, pictures, strict=True)
    ]


def _viewer_settings(splat: PageSplat, photos: PagePhotos) -> dict[str, Any]:
    """The settings of renderer.js."""
    near_plane = splat.options.near_plane
    training = training_cameras(photos.cameras, photos.parts)
    return {
        "nearPlane": near_plane,
        "farNearPlane": path_near_plane(splat.gaussians.means, training, near_plane),
        "lowPass": RasterOptions.eps2d,
        "antialiased": splat.options.antialiased,
        "margin": MARGIN,
        "background": splat.background.tolist(),
    }


def _camera_facts(cameras: Sequence[Mapping[str, Any]], parts: Sequence[str]) -> dict[str, str]:
    """The number of cameras, the size of their photos and their focal lengths, as text."""
    focal = sorted(camera["focal"][0] for camera in cameras)
    span = f"{focal[0]:.1f}" if focal[-1] - focal[0] < 0.1 else f"{focal[0]:.1f} to {focal[-1]:.1f}"
    width, height = cameras[0]["size"]
    share = focal[len(focal) // 2] / max(width, height)
    in_order = sorted(cameras, key=lambda camera: camera["name"])
    files = [f"{camera['label']}: {camera['name']}" for camera in in_order] if len(cameras) <= _LISTED else []
    counts = Counter(parts)
    each = [f"{count} {word}" for word, count in counts.items()]
    return {
        "cameras": " and ".join(each) if len(counts) > 1 else str(len(parts)),
        "photo size": f"{width} × {height} pixels",
        "focal length": f"{span} pixels, {share:.2f} of the longer side",
        **({"files": "; ".join(files)} if files else {}),
    }


def _costs(text: PageText) -> dict[str, str]:
    """Seconds of training, memory and backend of each run, as text."""
    costs = dict[str, str]()
    for run, metrics in text.runs.items():
        prefix = f"{run}: " if run else ""
        if metrics.get("seconds") is not None:
            costs[f"{prefix}training"] = f"{metrics['seconds']:.1f} s for {metrics.get('steps', '?')} steps"
        if metrics.get("peak_rss_mb"):
            costs[f"{prefix}peak memory"] = f"{metrics['peak_rss_mb']} MiB"
        if metrics.get("backend"):
            costs[f"{prefix}backend"] = str(metrics["backend"])
    return costs


def _megabytes(count: int) -> str:
    return f"{count / 1e6:.2f} MB"
