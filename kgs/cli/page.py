"""`kgs page`: a page that shows a splat."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kgs.errors import printable
from kgs.fit.config import Backend, Background
from kgs.io.console import as_line, say, say_next

from .inputs import load_cameras, load_splat
from .options import Existing, Out

if TYPE_CHECKING:
    import torch
    from kornia.geometry.camera import PinholeCamera


def page(
    ply: Existing,
    /,
    *,
    cameras: Existing,
    out: Out = Path("index.html"),
    downscale: float | None = None,
    background: Background = "black",
    photos: bool = True,
    roll: float = 0.0,
    device: str = "cpu",
    backend: Backend = "auto",
) -> None:
    """Write a page that shows a splat, in a viewer and beside the photos of a scene.

    For example:
      kgs page fern-3/splat.ply --cameras fern -o fern.html
      kgs page lego.ply --cameras lego -o lego.html --background white

    Args:
        ply: a 3DGS PLY file.
        cameras: the scene (LLFF, COLMAP, Blender or nerfstudio folder) whose cameras and photos to use.
        out: the HTML file to write.
        downscale: shrink the photos by this factor.
        background: behind the splat, and behind photos with transparency.
        photos: photos beside their renders; without them the page is small, and can be shown where they must not.
        roll: turn all pictures clockwise by this angle in degrees, where photos lie on their side.
        device: cpu, cuda, ...
        backend: as of kgs fit.
    """
    import torch

    from kgs.camera import move_camera
    from kgs.datasets import load_scene
    from kgs.losses.photometric import WINDOW
    from kgs.machine import check_tools, versions
    from kgs.metrics.evaluate import evaluate
    from kgs.page.fit_page import MOST_PICTURES, spread, write_fit_page

    place = check_tools(device, backend, "jinja2")
    scene = load_cameras(cameras, downscale, background=background)
    height, width = scene.train.images.shape[-2:]
    if min(height, width) < WINDOW:
        raise ValueError(f"downscale: expected photos of at least {WINDOW} pixels a side, got {width}x{height}")
    model, renderer = load_splat(ply, scene, place, backend)
    behind = scene.background.to(place)

    def render(camera: "PinholeCamera") -> "torch.Tensor":
        with torch.no_grad():
            image: torch.Tensor = renderer(model(), move_camera(camera, place), behind).image
        return image

    few = spread(len(scene.train), MOST_PICTURES)
    seen = load_scene(cameras, len(few), downscale, hold_out=0, background=background).train  # of another offset
    shown = replace(seen, cameras=scene.train.camera(few))
    runs = {"": {"views": evaluate(render, shown), "versions": versions()}}
    notes = ["Whether the splat was fitted to these photos is not known here."]
    title = f"{ply.stem}, {Path(cameras).resolve().name}"
    words: dict[str, Any] = {"words": ("photo", "test"), "notes": notes, "photos": photos, "roll": roll}
    near_plane = renderer.options.near_plane
    cost = write_fit_page(out, title, scene, model, near_plane, {"": render}, runs, shown=shown, **words)
    level = runs[""]["views"]["psnr"]
    say(
        f"{printable(out)}: {len(model)} Gaussians, {len(scene.train)} photos"
        + (f", PSNR {level:.4g}" if level else "")
    )
    if cost:
        say(f"the page shows {cost}; {printable(ply)} has everything")
    say_next(f"open {as_line(out)} in a browser")
