"""Host time of a training step on Triton's kernels, without a GPU: `python host_time.py BEFORE AFTER`.

BEFORE and AFTER are Python programs of two installations of kgs, which are measured in turn. Triton's driver is one
that says that there is a card of compute capability 9.0 and that launches nothing; all else is real: kernels are
compiled, arguments specialized, torch's operators called, on so small a scene that their own work hardly counts.
Numbers that are read are those that the same step reads in Triton's interpreter. Prints the medians of the processor
time of a step, in microseconds, and those with `launch` itself left out: of a step of `kgs bench speed`, and of one of
a Trainer, which also drops Gaussians, observes gradients and fades opacities.
"""

import argparse
import inspect
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

GAUSSIANS, SIZE = 100, (24, 32)
READS = ("tolist", "__int__")


def reads(replace: Callable[[Any, Callable[[], Any]], Any]) -> None:
    """Let a function of the tensor and of what it is, read really, say what the backend reads."""
    for name in READS:
        real = getattr(torch.Tensor, name)

        def read(tensor: Any, real: Any = real) -> Any:
            inside = "backends/gpu" in sys._getframe(1).f_code.co_filename.replace(os.sep, "/")
            return replace(tensor, lambda: real(tensor)) if inside else real(tensor)

        setattr(torch.Tensor, name, read)


def bench_step() -> Callable[[], Any]:
    """The training step of `kgs bench speed`."""
    from kgs.bench.speed import Cases

    found = Cases(GAUSSIANS, SIZE, torch.device("cpu"), "torch")
    found.renderer.backend = "triton"
    return found.train


def fit_step() -> Callable[[], Any]:
    """That of a Trainer, of harmonics of degree 3; nothing is due after it."""
    from kgs.datasets import synthetic_scene
    from kgs.fit import FitConfig, Trainer
    from kgs.fit.plan import make_plan
    from kgs.init_points import InitialPoints

    scene = synthetic_scene(train_views=2, test_views=1, size=SIZE, seed=1)
    config = FitConfig(steps=30_000, sh_degree=3, backend="triton")
    points = torch.rand(GAUSSIANS, 3, generator=torch.Generator().manual_seed(0))
    first = InitialPoints(points, points, "random")
    plan = make_plan(scene, config, first)
    schedule = plan.schedule._replace(sh=(0, 0, 0), densify=(), reset=(), haze=(), evaluate=())
    fit = Trainer(scene, replace(plan, schedule=schedule), first)
    fit._look_every = 10**9  # as in 19 of 20 steps on a GPU
    fit._loss = 0.0
    return fit.train_step


STEPS = {"bench": bench_step, "fit": fit_step}
WARM = 2  # steps before; the first with each view reads its camera


def record() -> None:
    """In the interpreter: print what each of the first steps of each kind reads."""
    found: dict[str, list[list[Any]]] = {}
    current: list[Any] = []

    def note(_: Any, real: Callable[[], Any]) -> Any:
        current.append(real())
        return current[-1]

    reads(note)
    for name, make in STEPS.items():
        step = make()
        found[name] = []
        for _ in range(WARM + 1):
            current.clear()
            step()
            found[name].append(list(current))
    print(json.dumps(found))


class Launcher:
    """Launches nothing."""

    def __init__(self, source: Any, metadata: Any) -> None:
        pass

    def __call__(self, *arguments: Any) -> None:
        """As Triton calls it."""


class Driver:
    """Of a card that is not there."""

    launcher_cls = Launcher

    def __init__(self) -> None:
        from triton.backends.compiler import GPUTarget

        self.utils = self
        self.target = GPUTarget("cuda", 90, 32)

    def get_current_target(self) -> Any:
        """What is compiled for."""
        return self.target

    def get_current_device(self) -> int:
        """Its number."""
        return 0

    def get_current_stream(self, device: int) -> int:
        """The default stream."""
        return 0

    def get_device_properties(self, device: int) -> dict[str, int]:
        """What Triton asks for."""
        return {"max_shared_mem": 232448}

    def load_binary(self, *arguments: Any) -> tuple[Any, ...]:
        """Module, function, registers, spills and, in newer versions of Triton, threads."""
        from triton.compiler import CompiledKernel

        found = (1, 1, 32, 0, 1024)
        return found if "n_max_threads" in inspect.getsource(CompiledKernel._init_handles) else found[:4]

    def unload_module(self, module: Any) -> None:
        """Nothing was loaded."""


def measure(steps: int, numbers: dict[str, list[list[Any]]]) -> None:
    """Print medians of steps of each kind, which read these numbers, and of steps without `launch`, as JSON."""
    import triton

    from kgs import stages
    from kgs.backends import gpu
    from kgs.backends.gpu import launch as launching

    gpu.GpuBackend.runs_on = lambda self, device: True
    stages._check_projected = lambda projected, features: None  # it looks at the numbers of a CPU's tensors
    add, rows = torch.Tensor.index_add_, dict[int, torch.Tensor]()

    def add_anywhere(tensor: Any, dim: int, index: Any, source: Any) -> Any:  # no kernel has written the rows
        if len(index) not in rows:
            rows[len(index)] = torch.zeros_like(index)
        return add(tensor, dim, rows[len(index)], source)

    torch.Tensor.index_add_ = add_anywhere
    made = {name: make() for name, make in STEPS.items()}
    triton.runtime.driver.set_active(Driver())
    if hasattr(launching, "_DIRECT"):
        launching._DIRECT = ("cpu",)
    to_read: list[Any] = []

    def replay(tensor: Any, real: Callable[[], Any]) -> Any:
        real()
        return to_read.pop()

    def run(name: str, read: list[Any]) -> float:
        to_read[:] = reversed(read)
        start = time.process_time_ns()
        made[name]()
        microseconds = (time.process_time_ns() - start) / 1e3
        assert not to_read
        return microseconds

    def timed(name: str, count: int) -> float:
        return statistics.median(run(name, numbers[name][-1]) for _ in range(count))

    reads(replay)
    for name in STEPS:
        for read in numbers[name]:  # compiles
            run(name, read)
        timed(name, 20)
    found = {name: timed(name, steps) for name in STEPS}
    for module in [module for name, module in sys.modules.items() if name.startswith("kgs.backends.gpu.")]:
        if module is not launching and hasattr(module, "launch"):
            module.launch = lambda *arguments, **options: None
    print(json.dumps(found | {f"{name} without launch": timed(name, steps) for name in STEPS}))


def output_of(command: list[str], environment: dict[str, str], given: str = "") -> Any:
    """The JSON in the last line that a program prints."""
    done = subprocess.run(command, env=environment, input=given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure two installations in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("programs", nargs="*", metavar="PYTHON")
    parser.add_argument("-n", type=int, default=5, help="times each is measured")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--record", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.record:
        return record()
    if arguments.measure:
        return measure(arguments.steps, json.loads(sys.stdin.read()))
    interpreted = os.environ | {"TRITON_INTERPRET": "1"}
    numbers = [json.dumps(output_of([program, __file__, "--record"], interpreted)) for program in arguments.programs]
    found: list[list[dict[str, float]]] = [[] for _ in arguments.programs]
    for _ in range(arguments.n):
        for program, read, medians in zip(arguments.programs, numbers, found, strict=True):
            command = [program, __file__, "--measure", "--steps", str(arguments.steps)]
            medians.append(output_of(command, dict(os.environ), read))
    for program, medians in zip(arguments.programs, found, strict=True):
        print(program)
        for name in medians[0]:
            values = [each[name] for each in medians]
            each = ", ".join(f"{x:.0f}" for x in values)
            print(f"  {name}: {statistics.median(values):.0f} us ({each})")


if __name__ == "__main__":
    main()
