"""Measuring time on a machine that others use too: cases take turns, medians are reported with their spread."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

import kgs.reference
from kgs.camera import move_camera

from .scenes import layered_scene

__all__ = ["Times", "calibrations", "take_turns"]

_EXP_ELEMENTS = 2**18


@dataclass(frozen=True)
class Times:
    """Seconds of one case over its repetitions.

    Args:
        wall: the median.
        best: the least.
        worst: the largest.
        cpu: median of the processor time of all threads.
        repeats: how many there were.
    """

    wall: float
    best: float
    worst: float
    cpu: float
    repeats: int


def take_turns(
    cases: Mapping[str, Callable[[], object]], repeats: int = 5, device: torch.device | None = None
) -> dict[str, Times]:
    """Run the cases one after the other, again and again, so that a slow minute of the machine slows all of them.

    Args:
        cases: name to what is timed; each is called once before, to warm up.
        repeats: rounds, >= 1.
        device: where they run; a GPU is waited for.
    """
    wait = torch.cuda.synchronize if device is not None and device.type == "cuda" else lambda: None
    walls: dict[str, list[float]] = {name: [] for name in cases}
    cpus: dict[str, list[float]] = {name: [] for name in cases}
    for round_ in range(repeats + 1):
        for name, case in cases.items():
            wall, cpu = time.perf_counter(), time.process_time()
            case()
            wait()
            if round_ > 0:
                walls[name].append(time.perf_counter() - wall)
                cpus[name].append(time.process_time() - cpu)
    return {
        name: Times(statistics.median(w), min(w), max(w), statistics.median(cpus[name]), repeats)
        for name, w in walls.items()
    }


def calibrations(device: torch.device) -> dict[str, float]:
    """What this machine does with two known pieces of work, in seconds: to compare figures of two machines.

    Returns:
        "exp": per element of `torch.exp` over 2^18 float32 in cache, on all threads. "dense": the dense float64
        reference with 400 Gaussians at 48x64, forward and backward.
    """
    values = torch.full((_EXP_ELEMENTS,), -1.0, device=device)
    results = torch.empty_like(values)

    def exponentials() -> None:
        for _ in range(50):
            torch.exp(values, out=results)

    model, camera = layered_scene(400, (48, 64))
    gaussians = model.to(device)()
    camera = move_camera(camera, device)

    def dense() -> None:
        kgs.reference.render(gaussians, camera).sum().backward(retain_graph=True)

    times = take_turns({"exp": exponentials, "dense": dense}, 5, device)
    return {"exp": times["exp"].best / 50 / _EXP_ELEMENTS, "dense": times["dense"].wall}
