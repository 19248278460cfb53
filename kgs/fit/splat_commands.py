"""What `kgs render` and `page` do: pictures and a page of a 3DGS file of any origin, from the cameras of a scene."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from kgs.errors import printable
from kgs.io.console import VIEWER, as_line, each, say, say_next

from .config import Backend, Background, Recipe


def render(
    ply: Path,
    /,
    *,
    cameras: Path,
    out: Path,
    downscale: float | None = None,
    background: Literal[Background, "transparent"] = "black",
    device: str = "cpu",
    backend: Backend = "auto",
) -> None:
    """Render a splat from every camera of a scene into PNGs.

    For example:
      kgs render fern-3/splat.ply --cameras fern -o renders
      kgs render fern-3/splat.ply --cameras fern -o small --downscale 8 --background white

    Args:
        ply: a 3DGS PLY file.
        cameras: the scene (LLFF, COLMAP, Blender or nerfstudio folder) whose cameras to use.
        out: folder for the PNGs, named like the scene's photos; not where these are.
        downscale: shrink the pictures by this factor.
        background: behind the splat; transparent: PNGs with an alpha channel.
        device: cpu, cuda, ...
        backend: as of kgs fit.
    """
    import torch

    from kgs.camera import move_camera
    from kgs.io.outputs import check_folder, png_names, write_png
    from kgs.machine import check_tools

    place = check_tools(device, backend)
    check_folder(out, (), cameras, make=False)
    clear = background == "transparent"
    scene = _load_cameras(cameras, downscale, background="black" if clear else background)
    model, renderer = _load_splat(ply, scene, place, backend)
    posed = [(name, views.camera(i)) for views in (scene.train, scene.test) for i, name in enumerate(views.names)]
    names = png_names(name for name, _ in posed)
    check_folder(out, names.values(), scene.root)
    outputs, behind = ("image", "alpha") if clear else ("image",), scene.background.to(place)
    for name, camera in each(posed, "pictures", "view"):
        with torch.no_grad():
            seen = renderer(model(), move_camera(camera, place), behind, outputs)
        image = torch.cat([seen.image / seen.alpha.clamp_min(1e-6), seen.alpha], 1) if clear else seen.image
        write_png(out / names[name], image[0])
    say(f"{len(names)} pictures in {printable(out)}")
    say_next(VIEWER.format(as_line(ply)))


def page(
    ply: Path,
    /,
    *,
    cameras: Path,
    out: Path = Path("index.html"),
    downscale: float | None = None,
    background: Background = "black",
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

    from kgs.camera import move_camera
    from kgs.datasets import load_scene
    from kgs.errors import DataError
    from kgs.io.outputs import is_own
    from kgs.machine import check_tools, versions
    from kgs.metrics.evaluate import evaluate
    from kgs.page.fit_page import MOST_PICTURES, spread, write_fit_page

    place = check_tools(device, backend, "jinja2")
    if out.suffix != ".html":
        raise ValueError(f"out: expected a file that ends in .html, got {str(out)!r}")
    if out.exists() and not is_own(out):
        raise DataError(out, "", "was not written by kgs and would be overwritten: choose another file with -o")
    if not out.absolute().parent.is_dir():
        raise DataError(out, "", "expected a file in a folder that is there")
    scene = _load_cameras(cameras, downscale, background=background, hold_out=0)
    model, renderer = _load_splat(ply, scene, place, backend)
    behind = scene.background.to(place)

    def render(camera: PinholeCamera) -> torch.Tensor:
        with torch.no_grad():
            image: torch.Tensor = renderer(model(), move_camera(camera, place), behind).image
        return image

    few = spread(len(scene.train), MOST_PICTURES)
    photos = load_scene(cameras, len(few), downscale, hold_out=0, background=background).train  # of another offset
    shown = replace(photos, cameras=scene.train.camera(few))
    runs = {"": {"views": evaluate(render, shown), "versions": versions()}}
    notes = ["Whether the splat was fitted to these photos is not known here."]
    title = f"{ply.stem}, {Path(cameras).resolve().name}"
    words: dict[str, Any] = {"words": ("photo", "test"), "notes": notes}
    near_plane = renderer.options.near_plane
    cost = write_fit_page(out, title, scene, model, near_plane, {"": render}, runs, shown=shown, **words)
    level = runs[""]["views"]["psnr"]
    say(
        f"{printable(out)}: {len(model)} Gaussians, {len(scene.train)} photos"
        + (f", PSNR {level:.4g}" if level else "")
    )
    if cost:
        say(f"to keep the page small it shows {cost}; {printable(ply)} has everything")
    say_next(f"open {as_line(out)} in a browser")


def _load_cameras(cameras: Path, downscale: float | None, **options: Any) -> Any:
    """The scene without its photos, of which there may be hundreds."""
    from kgs.datasets import load_scene

    scene = load_scene(cameras, None, downscale, photos=False, **options)
    for note in scene.notes:
        say(note)
    return scene


def _load_splat(ply: Path, scene: Any, place: Any, backend: str) -> tuple[Any, Any]:
    """The Gaussians in the frame of the scene, and a renderer whose near plane follows from them."""
    from kgs.geometry import typical_depths
    from kgs.io.ply import load_ply
    from kgs.renderer import GaussianRenderer

    model = load_ply(ply, origin=scene.offset)
    near_plane = Recipe().near_plane * typical_depths(model.means, scene.train.cameras)[0]
    return model.to(place), GaussianRenderer(near_plane=near_plane, backend=backend).eval()
