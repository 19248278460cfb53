"""`kgs bench`: what rendering costs on this machine, and how exact it is."""

from kgs.app.files.results import Results

from .options import Out
from .tools import check_installed, load_tools


def speed(*, out: Out, quick: bool = False, device: str = "auto") -> None:
    """Measure time and memory of renders and training steps with torch and with kernels.

    For example:
      kgs bench speed -o speed
      kgs bench speed -o speed --quick --device cuda

    Writes speed.csv, speed.md and scaling.png in minutes, with --quick in tens of seconds.

    Args:
        out: folder for the results, created if it does not exist.
        quick: fewer Gaussians and repetitions.
        device: auto: a GPU if kgs has kernels for it, else the CPU. Or cpu, cuda, cuda:1, ...
    """
    check_installed("matplotlib")
    with Results.open(out, "bench") as results:
        found = load_tools(device)

        from kgs.bench.speed import speed

        with results.stage(keep=True) as new:
            speed(out=new, quick=quick, device=str(found))


def precision(*, out: Out, quick: bool = False) -> None:
    """Measure errors of images and gradients against time, for each option of the renderer.

    For example:
      kgs bench precision -o precision
      kgs bench precision -o precision --quick

    Writes precision.csv, precision.md, render.png and gradients.png in 5 minutes, with --quick in half a minute.

    Args:
        out: folder for the results, created if it does not exist.
        quick: small images with few Gaussians.
    """
    check_installed("matplotlib")
    with Results.open(out, "bench") as results:
        load_tools()

        from kgs.bench.precision import precision

        with results.stage(keep=True) as new:
            precision(out=new, quick=quick)


def extremes(*, out: Out) -> int:
    """Measure errors of stiff and extreme cases, and compare them with bounds.

    For example:
      kgs bench extremes -o extremes
      OMP_NUM_THREADS=1 kgs bench extremes -o extremes-1

    Writes extremes.csv and extremes.md in seconds. The exit code is 1 if a bound is exceeded.

    Args:
        out: folder for the results, created if it does not exist.
    """
    with Results.open(out, "bench") as results:
        load_tools()

        from kgs.bench.extremes import extremes

        with results.stage(keep=True) as new:
            return extremes(out=new)
