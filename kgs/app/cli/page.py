"""`kgs page`: a page that shows a splat."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from kgs._support.errors import ArgumentError, printable, quantity
from kgs.app.console import as_line, open_in_browser, say, say_next
from kgs.fit.config import Backend, Background

from .checks import check_file, check_photos_of, check_roll, check_side
from .inputs import load_cameras, load_splat, open_splat, options_of_fit
from .options import Flag, IfGiven, Open, Out
from .tools import load_tools

if TYPE_CHECKING:
    from kgs.datasets.scene import Scene, Views


def page(
    splat: Path,
    /,
    *,
    out: Out = Path("index.html"),
    cameras: IfGiven[Path] = None,
    size: IfGiven[int] = None,
    downscale: IfGiven[float] = None,
    background: Background = "black",
    no_photos: Flag = False,
    roll: float = 0.0,
    open_page: Open = False,
    device: str = "auto",
    backend: Backend = "auto",
) -> None:
    """Write a page that shows a splat, in a viewer and beside the photos of a scene.

    For example:
      kgs page fern-3 -o fern.html --no-photos
      kgs page lego.ply --cameras lego -o lego.html --background white

    Args:
        splat: the folder of the results of kgs fit, or a 3DGS PLY file.
        out: the HTML file to write.
        cameras: the scene whose cameras and photos to use (folder of LLFF, COLMAP, Blender or nerfstudio). Unless
            given: that of the fit.
        size: reduce the photos to this many pixels on their longer side. Unless given: to the size of the fit, where
            the splat or the scene is in the folder of one.
        downscale: reduce the photos by this factor instead.
        background: the colour behind the splat, and behind photos with transparency.
        no_photos: leave out the photos beside their renders: the page is smaller, and can go where the photos must not.
        roll: turn all pictures clockwise by this angle in degrees, where photos lie on their side.
        open_page: open the page in a browser when it is written.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: the fastest that is installed. kgs fit --help-all describes the others.
    """
    from kgs.datasets.options import check_options

    check_roll(roll)
    check_options(downscale, None)
    if size is not None and downscale is not None:
        raise ArgumentError("size", "either a size or a downscale factor", "both")
    if size is not None:
        check_side(size)
    check_file(out, ".html")
    ply, source = open_splat(splat, cameras)
    check_photos_of(source)
    torch_device = load_tools(device, backend, "jinja2")

    from kgs._support.machine import versions
    from kgs.app.page.fit_page import MAX_PICTURES, load_small, spread, write_fit_page
    from kgs.datasets import load_scene
    from kgs.losses.photometric import WINDOW
    from kgs.metrics.evaluate import evaluate

    options = {**options_of_fit(ply, source), "background": background}
    if size is not None:
        downscale = max(1.0, max(source.photo_size()) / size)
    if downscale is not None:
        options |= {"downscale": downscale, "photo_folder": ""}
    scene = load_cameras(source, **options)
    height, width = scene.train.images.shape[-2:]
    if min(height, width) < WINDOW:
        name = "downscale" if size is None else "size"
        raise ArgumentError(name, f"photos of at least {WINDOW} pixels a side", f"{width}x{height}")
    fit = load_splat(ply, scene, torch_device, backend)
    few = spread(len(scene.train), MAX_PICTURES)
    photographed = load_scene(source, len(few), hold_out=0, **options)
    pictured = in_frame_of(scene, photographed)
    fit = replace(fit, metrics={"views": evaluate(fit.render, pictured), "versions": versions()})
    cost = write_fit_page(
        out,
        f"{splat.resolve().stem}, {source.root.resolve().name}",
        {"": fit},
        beside=pictured,
        words=("photo", "test"),
        notes=["If the splat was fitted to these photos, their PSNR says little about other views."],
        photos=not no_photos,
        roll=roll,
        small=None if no_photos else load_small(source, scene, background),
    )
    level = fit.metrics["views"]["psnr"]
    measured = f", PSNR {level:.4g}" if level is not None else ""
    photographs = f"{quantity(len(scene.train), 'photo')} of {width}x{height}"
    say(f"{printable(out)}: {len(fit.model)} Gaussians, {photographs}{measured}")
    if cost:
        say(f"the page shows {cost}; {printable(ply)} has everything")
    say_next(f"open {as_line(out)} in a browser")
    if open_page:
        open_in_browser(out)


def in_frame_of(scene: "Scene", again: "Scene") -> "Views":
    """Training views of a scene that was loaded again, with cameras in the frame of `scene`, whose offset differs."""
    from kgs.geometry.cameras import posed

    views = again.train
    extrinsics = views.cameras.extrinsics.double()
    shift = (scene.offset - again.offset).to(extrinsics)
    extrinsics[:, :3, 3] += extrinsics[:, :3, :3] @ shift
    return replace(views, cameras=posed(views.cameras, extrinsics.float()))
