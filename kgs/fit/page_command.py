"""What `kgs page` does: a page for a 3DGS file of any origin."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from .config import Backend, Recipe
from .progress import say


def page(
    ply: Path,
    /,
    *,
    cameras: Path,
    out: Path = Path("index.html"),
    downscale: float | None = None,
    background: Literal["black", "white"] = "black",
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
        device: cpu, cuda, ...
        backend: as of kgs fit.
    """
    import torch
    from kornia.geometry.camera import PinholeCamera

    from kgs.backends import resolve
    from kgs.camera import move_camera
    from kgs.datasets import load_scene
    from kgs.errors import DataError
    from kgs.ply import load_ply
    from kgs.renderer import GaussianRenderer

    from .machine import check_device, versions
    from .metrics import evaluate
    from .outputs import is_own
    from .page import MOST_PICTURES, spread, write_fit_page
    from .starts import typical_depths

    place = check_device(device)
    resolve(backend, place)
    if out.suffix != ".html":
        raise ValueError(f"out: expected a file that ends in .html, got {str(out)!r}")
    if out.exists() and not is_own(out):
        raise DataError(out, "", "was not written by kgs and would be overwritten: choose another file with -o")
    if not out.absolute().parent.is_dir():
        raise DataError(out, "", "expected a file in a folder that is there")
    options: dict[str, Any] = {"hold_out": 0, "background": background}
    scene = load_scene(cameras, None, downscale, **options, photos=False)  # there may be hundreds
    for note in scene.notes:
        say(note)
    model = load_ply(ply, origin=scene.offset).to(place)
    near_plane = Recipe().near_plane * typical_depths(scene.train, model.means.cpu())[0]
    renderer = GaussianRenderer(near_plane=near_plane, backend=backend).eval()
    behind = scene.background.to(place)

    def render(camera: PinholeCamera) -> torch.Tensor:
        with torch.no_grad():
            image: torch.Tensor = renderer(model(), move_camera(camera, place), behind).image
        return image

    few = spread(len(scene.train), MOST_PICTURES)
    photos = load_scene(cameras, len(few), downscale, **options).train  # the same ones; moved by another offset
    shown = replace(photos, cameras=scene.train.camera(few))
    runs = {"": {"views": evaluate(render, shown), "versions": versions()}}
    notes = ["Whether the splat was fitted to these photos is not known here."]
    title = f"{ply.stem}, {Path(cameras).resolve().name}"
    words: dict[str, Any] = {"words": ("photo", "test"), "notes": notes}
    cost = write_fit_page(out, title, scene, model, near_plane, {"": render}, runs, shown=shown, **words)
    level = runs[""]["views"]["psnr"]
    say(f"{out}: {len(model)} Gaussians, {len(scene.train)} photos" + (f", PSNR {level:.4g}" if level else ""))
    if cost:
        say(f"to keep the page small it shows {cost}; {ply} has everything")
    say(f"next:\n  open {out} in a browser")
