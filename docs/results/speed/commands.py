"""Times commands of two installations of kgs in turn: `python commands.py BEFORE AFTER SCENE PHOTOS`.

BEFORE and AFTER are the `kgs` programs of two virtual environments, SCENE is LLFF fern, PHOTOS a folder of six unposed
photos. Run each command once before, so that kernels are compiled. Prints for each command all wall times in seconds,
the ratio of their medians, and peak memory in MiB.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median


def timed(words: list[str], environment: dict[str, str]) -> tuple[float, float]:
    """Wall seconds, and peak memory in MiB, of a command."""
    start = time.perf_counter()
    process = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if status and "--sise" not in words:
        sys.exit(f"{words}: exit status {status}")
    return time.perf_counter() - start, usage.ru_maxrss / 1024


def main() -> None:
    """Time the commands that are named, all unless given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("programs", nargs=2, type=Path, metavar="KGS")
    parser.add_argument("scene", type=Path)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--only", default="demo,cold,help,mistake,fern,photos")
    parser.add_argument("-n", type=int, default=3)
    arguments = parser.parse_args()
    for name in arguments.only.split(","):
        seconds: list[list[float]] = [[], []]
        peaks: list[list[float]] = [[], []]
        for _ in range(arguments.n):
            for which, program in enumerate(arguments.programs):
                with tempfile.TemporaryDirectory() as folder:
                    environment = dict(os.environ)
                    environment["PATH"] = f"{program.parent}{os.pathsep}{environment['PATH']}"
                    if name == "cold":  # kernels are compiled
                        environment["XDG_CACHE_HOME"] = environment["NUMBA_CACHE_DIR"] = str(Path(folder) / "cache")
                    out = str(Path(folder) / "out")
                    words = {
                        "fern": ["fit", str(arguments.scene), "-o", out, "--views", "3", "--size", "504"],
                        "photos": ["fit", str(arguments.photos), "-o", out],
                        "demo": ["demo", "-o", out],
                        "cold": ["demo", "-o", out],
                        "help": ["--help"],
                        "mistake": ["fit", "--sise", "3"],
                    }[name]
                    took, peak = timed([str(program), *words], environment)
                    seconds[which].append(round(took, 2))
                    peaks[which].append(round(peak))
        ratio = median(seconds[1]) / median(seconds[0])
        print(name, seconds, f"ratio {ratio:.2f}", peaks, flush=True)


if __name__ == "__main__":
    main()
