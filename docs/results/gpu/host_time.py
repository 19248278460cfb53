"""Host time of a training step on Triton's kernels, without a GPU: `python host_time.py BEFORE AFTER`.

BEFORE and AFTER are Python programs of two installations of kgs, which are measured in turn. Triton's driver is one
that says that there is a card of compute capability 9.0 and that launches nothing; all else is real: kernels are
compiled, arguments specialized, torch's operators called, on so small a scene that their own work hardly counts.
Numbers that are read are those that the same step reads in Triton's interpreter. Prints the medians of the processor
time of a step, in microseconds, and those with `launch` itself left out.
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
from typing import Any

import torch

GAUSSIANS, SIZE = 100, (24, 32)
STAGES = ("compositing", "projection", "loss", "optimizer")
READS = ("tolist", "__int__")


def reads(replace: Callable[[Any, Callable[[], Any]], Any]) -> None:
    """Let a function of the tensor and of what it is, read really, say what the backend reads."""
    for name in READS:
        real = getattr(torch.Tensor, name)

        def read(tensor: Any, real: Any = real) -> Any:
            inside = "backends/gpu" in sys._getframe(1).f_code.co_filename.replace(os.sep, "/")
            return replace(tensor, lambda: real(tensor)) if inside else real(tensor)

        setattr(torch.Tensor, name, read)


def cases() -> Any:
    """What has the training step."""
    from kgs.bench.speed import Cases

    found = Cases(GAUSSIANS, SIZE, torch.device("cpu"), "torch")
    found.renderer.backend = "triton"
    return found


def record() -> None:
    """In the interpreter: print what a step reads."""
    step = cases().train
    step()
    found: list[Any] = []

    def note(_: Any, real: Callable[[], Any]) -> Any:
        found.append(real())
        return found[-1]

    reads(note)
    step()
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


def measure(steps: int, numbers: list[Any]) -> None:
    """Print the medians of a step that reads some numbers, and of one without `launch`, as JSON."""
    from importlib import import_module

    import triton

    from kgs import stages
    from kgs.backends import gpu

    gpu.GpuBackend.runs_on = lambda self, device: True
    stages._check_projected = lambda projected, features: None  # it looks at the numbers of a CPU's tensors
    step = cases().train
    triton.runtime.driver.set_active(Driver())
    launching = import_module("kgs.backends.gpu.launch")
    if hasattr(launching, "_DIRECT"):
        launching._DIRECT = ("cpu",)
    position = 0

    def replay(tensor: Any, real: Callable[[], Any]) -> Any:
        nonlocal position
        real()
        position += 1
        return numbers[position - 1]

    def timed(count: int) -> float:
        nonlocal position
        found = []
        for _ in range(count):
            position = 0
            start = time.process_time_ns()
            step()
            found.append((time.process_time_ns() - start) / 1e3)
            assert position == len(numbers)
        return statistics.median(found)

    reads(replay)
    timed(20)  # compiles
    whole = timed(steps)
    for name in STAGES:
        import_module(f"kgs.backends.gpu.{name}").launch = lambda *arguments, **options: None
    print(json.dumps([whole, timed(steps)]))


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
    found: list[list[list[float]]] = [[] for _ in arguments.programs]
    for _ in range(arguments.n):
        for program, read, medians in zip(arguments.programs, numbers, found, strict=True):
            command = [program, __file__, "--measure", "--steps", str(arguments.steps)]
            medians.append(output_of(command, dict(os.environ), read))
    for program, medians in zip(arguments.programs, found, strict=True):
        print(program)
        for name, values in zip(("step", "without launch"), zip(*medians, strict=True), strict=True):
            each = ", ".join(f"{x:.0f}" for x in values)
            print(f"  {name}: {statistics.median(values):.0f} us ({each})")


if __name__ == "__main__":
    main()
