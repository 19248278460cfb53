"""`kgs scale`: gives a splat and its cameras the unit of a known length."""

import math
from pathlib import Path

from kgs._support.errors import ArgumentError, printable, quoted
from kgs.app.console import as_line, say, say_next
from kgs.app.files.results import Results

from .checks import check_file, check_results
from .options import Out
from .tools import load_tools


def scale(splat: Path, /, *, by: tuple[str, str, float], out: Out) -> None:
    """Scale a splat and its cameras, so that two points are a known length apart.

    Measure, on the page of a fit under More, gives the points. The unit of the length is then that of the splat.

    For example:
      kgs scale fern-3 --by 0.1,0.2,3.5 -0.4,0.2,3.6 1.25 -o fern-metres
      kgs scale splat.ply --by 0,0,0 0,0,1 2.5 -o metres.ply

    Args:
        splat: the folder of the results of kgs fit, or a 3DGS PLY file.
        by: two points, each as x,y,z in the coordinates of the PLY file, and their distance in the unit that is wanted.
        out: folder for splat.ply, splat.compressed.ply, splat.glb, cameras.json and index.html; for a PLY file the PLY
            file to write.
    """
    a, b, length = by
    if not (math.isfinite(length) and length > 0):
        raise ArgumentError("by", "a length above 0", f"{length:g}")
    distance = math.dist(_point(a), _point(b))
    if not (0 < distance < math.inf and 0 < length / distance < math.inf):
        raise ArgumentError("by", f"two points that can be {length:g} apart", f"{a} and {b}")
    factor = length / distance
    if splat.is_dir():
        _scale_folder(splat, out, factor, length)
    else:
        _scale_ply(splat, out, factor, _point(a))
    say(f"{printable(out)}: {factor:.6g} times as large")
    if splat.is_dir():
        say_next(f"open {as_line(out / 'index.html')} in a browser")


def _scale_folder(folder: Path, out: Path, factor: float, length: float) -> None:
    """Write the files of a fit in the new unit; the fit stays as it is."""
    check_results(folder)
    with Results.open(out, "scale") as results:
        load_tools("cpu", "auto", "jinja2", "safetensors")

        from kgs._support.json_files import read_json
        from kgs.app.files.exports import write_splat_exports
        from kgs.app.page.fit_page import write_own_page
        from kgs.app.saved_fit import load_fit
        from kgs.fit.scale import scaled
        from kgs.ply import save_ply

        request, fit = load_fit(folder, say=say)
        fit = scaled(fit, factor)
        settings = read_json(folder / "config.json")
        note = f"The splat was scaled by {factor:.6g} after the fit, for a length of {length:g}"
        with results.stage() as new:
            save_ply(new / "splat.ply", fit.model, offset=fit.scene.offset)
            write_splat_exports(fit, new, request.roll)
            write_own_page(new, folder, fit, request, settings, remarks=[f"{note}; settings are those before."])


def _scale_ply(ply: Path, out: Path, factor: float, near: list[float]) -> None:
    """Write a scaled PLY file; positions are read relative to a point near them, because float32 holds few digits."""
    check_file(out, ".ply", ply)
    load_tools()

    import torch

    from kgs.fit.scale import scaled_model
    from kgs.ply import load_ply, save_ply

    origin = torch.tensor(near, dtype=torch.float64)
    model = scaled_model(load_ply(ply, origin=origin), factor)
    save_ply(out, model, offset=factor * origin)


def _point(text: str) -> list[float]:
    """Three numbers with commas between them; a ValueError where there are none."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise ArgumentError("by", "a point as 1.5,-2,0.25", quoted(text))
    return values
