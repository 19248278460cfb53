"""How long kernels take to compile that a first use needs, without a GPU: `python first_use.py`.

Those of the self-check and of training steps, for compute capability 9.0, each time in a new process with an empty
cache, in turn one after another and side by side in two threads. Prints seconds, processor time, and how many threads
ran or waited for a core on average, as Linux counts it: how many would have run on a machine with nothing else to do.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import torch

WAYS = ("one after another", "side by side")


def measure(way: str) -> None:
    """Compile in one of the ways; print how many kernels, seconds, processor time and threads as JSON."""
    import triton
    from host_time import Driver

    from kgs.backends.agreement import FITS, run_stages
    from kgs.backends.gpu import GpuBackend, compiling
    from kgs.backends.gpu.compiling import compile_together, needed_launches

    cpu = torch.device("cpu")
    triton.runtime.driver.set_active(Driver())
    launches = needed_launches(lambda: run_stages(GpuBackend(), cpu, FITS))
    compiling.cores = lambda: 1 + WAYS.index(way)
    active: dict[int, list[float]] = {}
    compile_one = compiling._compile

    def counted(*arguments: Any) -> None:
        compile_one(*arguments)
        thread = threading.get_native_id()
        numbers = Path(f"/proc/self/task/{thread}/schedstat").read_text().split()
        active[thread] = [int(x) / 1e9 for x in numbers[:2]]

    compiling._compile = counted
    start = time.perf_counter()
    compile_together(launches, cpu)
    seconds = time.perf_counter() - start
    assembler = resource.getrusage(resource.RUSAGE_CHILDREN)
    children = assembler.ru_utime + assembler.ru_stime
    used = sum(ran for ran, _ in active.values()) + children
    waited = sum(waiting for _, waiting in active.values())
    print(json.dumps([len(launches), seconds, used, (used + waited) / seconds]))


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
                count, seconds, used, active = json.loads(done.stdout.splitlines()[-1])
                print(f"{way}: {count} kernels, {seconds:.1f} s, {used:.1f} s of processor time, {active:.2f} threads")


if __name__ == "__main__":
    main()
