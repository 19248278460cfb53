"""`kgs render`: pictures of a splat."""

from pathlib import Path
from typing import Literal

from kgs._support.errors import printable, quantity
from kgs.app.console import VIEWER, as_line, each, say, say_next
from kgs.fit.config import Backend, Background

from .inputs import load_cameras, load_splat
from .options import IfGiven, Out
from .tools import load_tools


def render(
    ply: Path,
    /,
    *,
    cameras: Path,
    out: Out,
    downscale: IfGiven[float] = None,
    background: Literal[Background, "transparent"] = "black",
    device: str = "auto",
    backend: Backend = "auto",
) -> None:
    """Render a splat from every camera of a scene into PNGs.

    A splat that its file calls antialiased is rendered so. If no camera sees the splat, nothing is written.

    For example:
      kgs render fern-3/splat.ply --cameras fern -o renders
      kgs render fern-3/splat.ply --cameras fern -o small --downscale 8 --background white

    Args:
        ply: a 3DGS PLY file.
        cameras: the scene whose cameras to use: the folder of the results of kgs fit, or one of LLFF, COLMAP, Blender
            or nerfstudio.
        out: folder for the PNGs, which are named like the scene's photos; not the folder of the photos.
        downscale: reduce the pictures by this factor.
        background: the colour behind the splat; transparent: PNGs with an alpha channel.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
        backend: auto: the fastest that is installed. kgs fit --help-all describes the others.
    """
    from kgs.app.files.outputs import check_folder, png_names, write_png
    from kgs.datasets.options import check_options
    from kgs.datasets.source import SceneSource

    check_options(downscale, None)
    check_folder(out, cameras, make=False)
    source = SceneSource(cameras)
    torch_device = load_tools(device, backend)

    import torch

    from kgs.app.files.cameras import as_taken
    from kgs.app.files.publishing import check_free, replacing
    from kgs.geometry.cameras import to
    from kgs.renderer import GaussianRenderer

    is_transparent = background == "transparent"
    scene = load_cameras(source, downscale, background="black" if is_transparent else background)
    fit = load_splat(ply, scene, torch_device, backend)
    renderer = GaussianRenderer(options=fit.options, backend=backend).eval()
    names = png_names(scene.train.names)
    check_free(out, "renders", names.values())
    color = scene.background.to(torch_device)
    outputs = ("image", "alpha") if is_transparent else ("image",)
    with replacing(out, "renders") as new, torch.no_grad():
        for i, name in each(list(enumerate(scene.train.names)), "pictures", "view"):
            rendering = renderer(fit.model(), to(scene.train.camera(i), torch_device), color, outputs)
            image = rendering.image
            if is_transparent:  # PNG's colours are not multiplied by alpha
                image = torch.cat([image / rendering.alpha.clamp_min(1e-6), rendering.alpha], 1)
            write_png(new / names[name], as_taken(image[0], scene.train, i))
    height, width = scene.train.images.shape[-2:]
    say(f"{quantity(len(names), 'picture')} of {width}x{height} in {printable(out)}")
    say_next(VIEWER.format(as_line(ply)))
