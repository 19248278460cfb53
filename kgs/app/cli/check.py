"""`kgs check`: what is installed, and whether it works."""

from .options import IfGiven
from .tools import load_tools


def check(*, device: IfGiven[str] = None) -> int:
    """Check this installation: versions, devices, and whether each backend is right and how fast it is.

    For example:
      kgs check
      kgs check --device cuda:1

    Run it first, and put what it prints into a bug report. It takes 20 seconds; the first time, when the kernels are
    compiled, a minute. The exit code is 1 if something is wrong.

    Args:
        device: what to check: cpu, cuda, cuda:1, xpu, ... Unless given: the CPU and all GPUs.
    """
    load_tools()

    from kgs.bench.check import check

    return check(device=device)
