"""How long kernels take to compile that a first use needs, without a GPU: `python first_use.py`.

Those of the self-check and of training steps, for compute capability 9.0, each time in a new process with an empty
cache, in turn one after another and side by side. Prints seconds and, of each, processor time.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time

import torch

WAYS = ("one after another", "side by side")


def measure(way: str) -> None:
    """Compile in one of the ways; print how many kernels, seconds and processor time as JSON."""
    import triton
    from host_time import Driver

    from kgs.backends.agreement import FITS, _run
    from kgs.backends.gpu import GpuBackend
    from kgs.backends.gpu.compiling import compile_together, needed_launches

    cpu = torch.device("cpu")
    triton.runtime.driver.set_active(Driver())
    launches = needed_launches(lambda: _run(GpuBackend(), cpu, FITS))
    start = time.perf_counter()
    if way == WAYS[0]:
        for launch in launches:
            launch.kernel.warmup(*launch.arguments, grid=launch.grid, **launch.options)
    else:
        compile_together(launches, cpu)
    seconds = time.perf_counter() - start
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(json.dumps([len(launches), seconds, sum(x.ru_utime + x.ru_stime for x in used)]))


def main() -> None:
    """Measure both in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=3, help="times each is measured")
    parser.add_argument("--measure", choices=WAYS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.measure:
        return measure(arguments.measure)
    for _ in range(arguments.n):
        for way in WAYS:
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, __file__, "--measure", way]
                environment = os.environ | {"TRITON_CACHE_DIR": folder}
                done = subprocess.run(command, env=environment, capture_output=True, text=True)
                assert done.returncode == 0, done.stderr
                count, seconds, used = json.loads(done.stdout.splitlines()[-1])
                print(f"{way}: {count} kernels, {seconds:.1f} s, {used:.1f} s of processor time")


if __name__ == "__main__":
    main()
