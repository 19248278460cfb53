"""`kgs render`: pictures of a splat."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from kgs._support.errors import printable, quantity
from kgs.app.console import VIEWER, as_line, each, say, say_next
from kgs.app.files.results import Results
from kgs.fit.config import Backend, Background

from .inputs import load_cameras, load_splat, open_splat
from .options import IfGiven, Out
from .tools import load_tools

if TYPE_CHECKING:
    from kgs.fit.fit import Fit


def render(
    splat: Path,
    /,
    *,
    out: Out,
    cameras: IfGiven[Path] = None,
    downscale: IfGiven[float] = None,
    background: Literal[Background, "transparent"] = "black",
    device: str = "auto",
    backend: Backend = "auto",
) -> None:
    """Render a splat from every camera of a scene into PNGs.

    They have the size of the scene's photos, unless --downscale is given, and no distortion of a lens: the photos of
    the fit itself, beside which its page shows them, may be smaller and were undistorted. A splat that its file calls
    antialiased is rendered so. If no camera sees the splat, nothing is written.

    For example:
      kgs render fern-3 -o renders
      kgs render lego.ply --cameras lego -o small --downscale 8 --background white

    Args:
        splat: the folder of the results of kgs fit, or a 3DGS PLY file.
        out: folder for the PNGs, which are named like the scene's photos.
        cameras: the scene whose cameras to use (folder of LLFF, COLMAP, Blender or nerfstudio). Unless given: that of
            the fit.
        downscale: reduce the pictures by this factor.
        background: the colour behind the splat; transparent: PNGs with an alpha channel.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: the fastest that is installed. kgs fit --help-all describes the others.
    """
    from kgs.datasets.options import check_options

    check_options(downscale, None)
    with Results.open(out, "renders") as results:
        ply, source = open_splat(splat, cameras)
        torch_device = load_tools(device, backend)
        is_transparent = background == "transparent"
        scene = load_cameras(source, downscale, background="black" if is_transparent else background)
        fit = load_splat(ply, scene, torch_device, backend)
        with results.stage(keep=True) as new:
            _write_renders(new, fit, is_transparent)
    height, width = scene.train.images.shape[-2:]
    say(f"{quantity(len(scene.train), 'picture')} of {width}x{height} in {printable(out)}")
    say_next(VIEWER.format(as_line(ply)))


def _write_renders(folder: Path, fit: "Fit", is_transparent: bool) -> None:
    """Write what each camera of the scene sees."""
    import torch

    from kgs.app.files.cameras import as_taken
    from kgs.app.files.outputs import png_names, write_png
    from kgs.geometry.cameras import to
    from kgs.renderer import GaussianRenderer

    views = fit.scene.train
    renderer = GaussianRenderer(options=fit.options, backend=fit.backend).eval()
    color = fit.scene.background.to(fit.device)
    outputs = ("image", "alpha") if is_transparent else ("image",)
    names = png_names(views.names)
    with torch.no_grad():
        for i, name in each(list(enumerate(views.names)), "pictures", "view"):
            rendering = renderer(fit.model(), to(views.camera(i), fit.device), color, outputs)
            image = rendering.image
            if is_transparent:  # PNG's colours are not multiplied by alpha
                image = torch.cat([image / rendering.alpha.clamp_min(1e-6), rendering.alpha], 1)
            write_png(folder / names[name], as_taken(image[0], views, i))
