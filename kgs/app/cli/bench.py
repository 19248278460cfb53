"""`kgs bench`: what rendering costs on this machine, and how exact it is."""

from pathlib import Path

from .options import Out
from .tools import check_installed, load_tools


def speed(*, out: Out, quick: bool = False, device: str = "auto") -> None:
    """Measure time and memory of renders and training steps with torch and numba.

    For example:
      kgs bench speed -o speed
      kgs bench speed -o speed --quick --device cuda

    Writes speed.csv, speed.json, speed.md and scaling.png in minutes, with --quick in tens of seconds.

    Args:
        out: folder for the results, created if it does not exist.
        quick: fewer Gaussians and repetitions.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
    """
    check_installed("matplotlib")
    found = _begin(out, "speed", "scaling.png", device=device)

    from kgs.app.files.publishing import replacing
    from kgs.bench.speed import speed

    with replacing(out, "bench speed") as new:
        speed(out=new, quick=quick, device=found)


def precision(*, out: Out, quick: bool = False) -> None:
    """Measure errors of images and gradients against time, for each option of the renderer.

    For example:
      kgs bench precision -o precision
      kgs bench precision -o precision --quick

    Writes precision.csv, .json and .md, render.png and gradients.png in 5 minutes, with --quick in half a minute.

    Args:
        out: folder for the results, created if it does not exist.
        quick: small images with few Gaussians.
    """
    check_installed("matplotlib")
    _begin(out, "precision", "render.png", "gradients.png")

    from kgs.app.files.publishing import replacing
    from kgs.bench.precision import precision

    with replacing(out, "bench precision") as new:
        precision(out=new, quick=quick)


def extremes(*, out: Out) -> int:
    """Measure errors of stiff and extreme cases, and compare them with bounds.

    For example:
      kgs bench extremes -o extremes
      OMP_NUM_THREADS=1 kgs bench extremes -o extremes-1

    Writes extremes.csv, extremes.json and extremes.md in seconds. The exit code is 1 if a bound is exceeded.

    Args:
        out: folder for the results, created if it does not exist.
    """
    _begin(out, "extremes")

    from kgs.app.files.publishing import replacing
    from kgs.bench.extremes import extremes

    with replacing(out, "bench extremes") as new:
        return extremes(out=new)


def _begin(out: Path, name: str, *pictures: str, device: str = "cpu") -> str:
    """Check the folder of a benchmark, which writes files of its name and pictures; load torch, and name the device."""
    from kgs.app.files.outputs import check_folder
    from kgs.app.files.publishing import check_free

    check_folder(out, make=False)
    check_free(out, f"bench {name}", (f"{name}.csv", f"{name}.json", f"{name}.md", *pictures))
    return str(load_tools(device))
