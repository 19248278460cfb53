"""Measuring time on a machine that others use too: cases take turns, medians are reported with their spread."""

import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch

CPU = torch.device("cpu")
Case = Callable[[], object]


class Times(NamedTuple):
    """Seconds of one case over its repetitions: median, least and largest; and the median of all threads' CPU time."""

    wall: float
    best: float
    worst: float
    cpu: float


def take_turns(cases: dict[str, Case], repeats: int = 5, device: torch.device = CPU) -> dict[str, Times]:
    """Run the cases in turn, so that a slow minute of the machine slows all: one warm-up and `repeats` timed rounds."""

    def one_round() -> Iterator[str]:
        for name, case in cases.items():
            case()
            yield name

    return time_parts(one_round, repeats, device)


def time_parts(run: Callable[[], Iterator[str]], repeats: int = 5, device: torch.device = CPU) -> dict[str, Times]:
    """As `take_turns`, of the parts of `run`, which yields the name of each when it is done; a GPU is waited for."""
    wait = (lambda: None) if device.type == "cpu" else torch.get_device_module(device).synchronize
    walls: dict[str, list[float]] = {}
    cpus: dict[str, list[float]] = {}
    for round_ in range(repeats + 1):
        wall, cpu = time.perf_counter(), time.process_time()
        for name in run():
            wait()
            if round_ > 0:
                walls.setdefault(name, []).append(time.perf_counter() - wall)
                cpus.setdefault(name, []).append(time.process_time() - cpu)
            wall, cpu = time.perf_counter(), time.process_time()
    median = statistics.median
    return {name: Times(median(of), min(of), max(of), median(cpus[name])) for name, of in walls.items()}


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Processes that do nothing but keep cores busy, while the block runs."""
    busy = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def seconds_of_exp(device: torch.device) -> float:
    """Seconds per element of `torch.exp` over 2^18 float32 in cache, on all threads: to compare two machines."""
    values = torch.full((2**18,), -1.0, device=device)
    results = torch.empty_like(values)
    times = take_turns({"exp": lambda: [torch.exp(values, out=results) for _ in range(50)]}, 5, device)
    return times["exp"].best / 50 / len(values)
