"""`kgs export`: a splat in fewer bytes, for viewers in browsers."""

from pathlib import Path

from kgs._support.errors import DataError, printable
from kgs.app.console import VIEWER, as_line, say, say_next

from .checks import check_file, check_results
from .options import Out
from .tools import load_tools


def export(
    splat: Path,
    /,
    *,
    out: Out = Path("splat.compressed.ply"),
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write a splat as a compressed PLY file, a quarter of the bytes.

    SuperSplat, PlayCanvas, GaussianSplats3D, Spark and Babylon.js read it. Its numbers are rounded: keep the plain PLY,
    which kgs and programs that edit splats need.

    For example:
      kgs export fern-3 -o fern.compressed.ply
      kgs export survey.ply -o survey.compressed.ply --origin 500000 5400000 300

    Args:
        splat: the folder of the results of kgs fit, or a 3DGS PLY file.
        out: the file to write, which ends in .ply.
        origin: a point that becomes the origin, x y z: one near the Gaussians of a splat in map coordinates, which
            viewers cannot show there.
    """
    ply = splat
    if splat.is_dir():
        check_results(splat)
        ply = splat / "splat.ply"
    check_file(out, ".ply", ply)
    load_tools()

    import torch

    from kgs.compressed_ply import save_compressed_ply
    from kgs.ply import load_ply

    model = load_ply(ply, torch.tensor(origin, dtype=torch.float64))
    if not len(model):
        raise DataError(ply, "vertex", "at least one Gaussian", "none")
    save_compressed_ply(out, model)
    sizes = [path.stat().st_size / 1e6 for path in (out, ply)]
    say(f"{printable(out)}: {len(model)} Gaussians, {sizes[0]:.2f} MB of {sizes[1]:.2f}")
    say_next(VIEWER.format(as_line(out)))
