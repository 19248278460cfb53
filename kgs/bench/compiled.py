"""What Triton makes of the kernels of `kgs.backends.gpu` for cards that are not there, and how long they would take.

    python -m kgs.bench.compiled FOLDER

writes compiled.csv and compiled.md: registers, spills and instructions of each kernel by target, and an estimate of a
training step's milliseconds from below. Nothing of it was measured on a card. It needs Triton 3.3 or newer.
"""

import csv
import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import torch

from kgs.backends.torch.binning import bin_to_tiles
from kgs.camera import pinhole_cameras
from kgs.renderer import GaussianRenderer
from kgs.stages import project

from .output import markdown_table
from .scenes import layered_scene
from .speed import SIZE

STAGES = ("compositing", "projection", "loss")
TARGETS: dict[str, tuple[str, Any, int]] = {
    "sm_75": ("cuda", 75, 32),
    "sm_80": ("cuda", 80, 32),
    "sm_90": ("cuda", 90, 32),
    "sm_120": ("cuda", 120, 32),
    "gfx942": ("hip", "gfx942", 64),
    "gfx1100": ("hip", "gfx1100", 32),
}
_TYPES = {"float32": "*fp32", "int64": "*i64", "int32": "*i32", "int16": "*i16", "int8": "*i8"}
COUNTS = (10_000, 50_000, 200_000)


class Card(NamedTuple):
    """What an estimate needs of a card."""

    target: str
    issues: float  # instructions of warps that all its processors can begin in a second
    bandwidth: float  # bytes a second


CARDS = {
    "H100 SXM": Card("sm_90", 132 * 4 * 1.76e9, 3.35e12),
    "RTX 4090": Card("sm_80", 128 * 4 * 2.52e9, 1.01e12),
    "MI300X": Card("gfx942", 304 * 4 * 2.1e9, 5.3e12),
}
LAUNCH = 5e-6  # seconds of the host for a kernel or an operator


class Kernel(NamedTuple):
    """A kernel as a training step calls it."""

    module: str
    name: str
    signature: dict[str, str]
    constants: dict[str, Any]
    warps: int


class Compiled(NamedTuple):
    """What a compiler made of a kernel; spills in bytes."""

    registers: int
    spills: int
    instructions: int


def kernels(every_form: bool = False) -> list[Kernel]:
    """The kernels of a training step, with the types of their arguments: from a step in the interpreter.

    With `every_form` also the forms that other calls use: several cameras, their gradients, features, row slices.
    """
    program = f"from kgs.bench.compiled import _record; _record({every_form})"
    environment = os.environ | {"TRITON_INTERPRET": "1"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True, text=True)
    return [Kernel(*each) for each in json.loads(done.stdout.splitlines()[-1])]


def _record(every_form: bool) -> None:
    """Print the kernels as JSON; in the interpreter."""
    from kgs.bench.speed import Cases

    found: dict[Any, tuple[Any, ...]] = {}

    def launch(kernel: Any, grid: Any, *arguments: Any, warps: int = 4, **constants: Any) -> None:
        names = [name for name in kernel.arg_names if name not in constants]
        given = dict(zip(names, arguments, strict=True))
        as_they_are = kernel.kwargs["do_not_specialize"] or ()
        ones = {name: 1 for name, value in given.items() if type(value) is int and value == 1}  # as Triton does
        ones = {name: value for name, value in ones.items() if name not in as_they_are}
        signature = {name: _type_of(value) for name, value in given.items() if name not in ones}
        form = (kernel.fn.__name__, *sorted((constants | ones).items())) if every_form else kernel.fn.__name__
        found[form] = (kernel.fn.__module__, kernel.fn.__name__, signature, constants | ones, warps)
        real(kernel, grid, *arguments, warps=warps, **constants)

    stages: list[Any] = [import_module(f"kgs.backends.gpu.{name}") for name in STAGES]
    real = stages[0].launch
    for stage in stages:
        stage.launch = launch
    Cases(40, (16, 16), torch.device("cpu"), "triton").train()
    if every_form:
        _draw_everything()
    print(json.dumps(list(found.values())))


def _draw_everything() -> None:
    """What a training step does not ask for."""
    model, camera = layered_scene(40, (24, 24))
    single = replace(model(), **{name: value.detach().requires_grad_() for name, value in vars(model()).items()})
    pose = camera.extrinsics.repeat(2, 1, 1).requires_grad_()
    cameras = pinhole_cameras(pose, camera.intrinsics[0], 24, 24)
    opacities = single.opacities.repeat(2, 1)
    for gaussians, max_bytes in ((single, 2**17), (replace(single, opacities=opacities), 2**30)):
        renderer = GaussianRenderer(backend="triton", absgrad=True, max_bytes=max_bytes)
        out = renderer(gaussians, cameras, outputs=("image", "median_depth"))
        assert out.image is not None
        out.image.square().sum().backward()
    features = replace(single, colors=torch.rand(40, 9, requires_grad=True))
    out = GaussianRenderer(backend="triton")(features, cameras)
    assert out.image is not None
    out.image.square().sum().backward()


def _type_of(argument: Any) -> str:
    if isinstance(argument, torch.Tensor):
        return _TYPES[str(argument.dtype).removeprefix("torch.")]
    return "i32" if isinstance(argument, int) else "fp32"


def build(kernel: Kernel, target: str) -> Compiled:
    """Compile a kernel for a target; needs no card."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    function = getattr(import_module(kernel.module), kernel.name)
    names = [name for name in function.arg_names if name not in kernel.signature]
    signature = {name: kernel.signature.get(name, "constexpr") for name in function.arg_names}
    source = ASTSource(fn=function, signature=signature, constexprs={name: kernel.constants[name] for name in names})
    options = {"num_warps": kernel.warps, "enable_fp_fusion": True}
    code = triton.compile(source, target=GPUTarget(*TARGETS[target]), options=options).asm
    if "amdgcn" in code:
        text = code["amdgcn"]
        registers, spills = (int(re.findall(rf"\.{name}:\s+(\d+)", text)[0]) for name in _AMD)
        return Compiled(
            registers, 4 * spills, len(re.findall(r"^\s+[sv]_\w+|^\s+(?:global|ds|buffer)_\w+", text, re.M))
        )
    tools = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        Path(file.name).write_bytes(code["cubin"])
        use, lines = (
            subprocess.run([tools / "cuobjdump", option, file.name], capture_output=True, check=True, text=True).stdout
            for option in ("-res-usage", "-sass")
        )
    registers, spills = (int(re.findall(rf"{name}:(\d+)", use)[0]) for name in ("REG", "STACK"))
    return Compiled(registers, spills, len(re.findall(r"/\*[0-9a-f]{4,}\*/ +[@A-Z]", lines)))


_AMD = ("vgpr_count", "vgpr_spill_count")


def estimate(found: dict[tuple[str, str], Compiled], card: Card, count: int) -> dict[str, float]:
    """Seconds of each kernel in a training step of `count` Gaussians, from below, and of the host.

    Of the time to begin all instructions and that to pass all bytes once the larger: no waiting, no divergence. A
    kernel with a loop is counted as if all its instructions were in it.
    """
    model, camera = layered_scene(count, SIZE)
    with torch.no_grad():
        seen = project(model(), camera)
        lists = bin_to_tiles(seen)
    pixels, n, m, entries = 3 * SIZE[0] * SIZE[1], count, len(seen), len(lists.entries)
    chunks = int((-(-lists.offsets.diff() // 8)).sum())
    lanes = TARGETS[card.target][2]
    # warps that go through each kernel once, and the bytes that it reads and writes
    work = {
        "describe_cameras": (1, 0),
        "check_gaussians": (n / lanes, 240 * n),
        "find_seen": (n / lanes, 45 * n),
        "list_seen": (n / lanes, 60 * n + 270 * m),
        "fill_table": (m / lanes, 80 * m),
        "count_entries": (3 * m / lanes, 70 * m),
        "fill_entries": (3 * m / lanes, 70 * m + 6 * entries),
        "composite_forward": (chunks, 60 * entries + 256 * chunks + 4 * pixels),
        "composite_backward": (chunks, 120 * entries + 256 * chunks + 4 * pixels),
        "sum_entries": (4 * m / 8, 48 * entries + 110 * m),
        "footprint_gradients": (n / lanes, 240 * n + 60 * n + 270 * m),
        "sum_across": (pixels / lanes, 20 * pixels),
        "ssim_maps": (pixels / lanes, 40 * pixels),
        "fold_down": (3 * pixels / lanes, 24 * pixels),
        "gradient_across": (pixels / lanes, 24 * pixels),
    }
    seconds = {
        name: max(warps * found[name, card.target].instructions / card.issues, bytes_ / card.bandwidth)
        for name, (warps, bytes_) in work.items()
    }
    return seconds | {"sorts and other operators": (40 * entries + 30 * m + 500 * n) / card.bandwidth}


def main(out: Path, launches: int = 102) -> None:
    """Write the tables; `launches`: kernels and operators of a training step, counted by the tests."""
    out.mkdir(parents=True, exist_ok=True)
    found = {(kernel.name, target): build(kernel, target) for kernel in kernels() for target in TARGETS}
    names = list(dict.fromkeys(name for name, _ in found))
    with (out / "compiled.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["kernel", "target", *Compiled._fields])
        writer.writerows([*key, *value] for key, value in found.items())
    cells = [[name, *(_cell(found[name, target]) for target in TARGETS)] for name in names]
    text = markdown_table("Registers, instructions, and spills where there are any", TARGETS, cells, "kernel")
    for name, card in CARDS.items():
        columns = {count: estimate(found, card, count) for count in COUNTS}
        rows = [[kernel, *(f"{1e3 * columns[count][kernel]:.3f}" for count in COUNTS)] for kernel in columns[COUNTS[0]]]
        totals = [sum(columns[count].values()) for count in COUNTS]
        rows.append(["all kernels", *(f"{1e3 * total:.2f}" for total in totals)])
        rows.append([f"host, {launches} launches", *(f"{1e3 * launches * LAUNCH:.2f}" for _ in COUNTS)])
        title = f"An estimate from below for one {name}, code of {card.target}, in milliseconds of a training step"
        text += markdown_table(title, [f"{count} Gaussians" for count in COUNTS], rows, "kernel")
    (out / "compiled.md").write_text(text, encoding="utf-8")
    print(text)


def _cell(compiled: Compiled) -> str:
    spills = f", {compiled.spills} bytes spilled" if compiled.spills else ""
    return f"{compiled.registers}, {compiled.instructions}{spills}"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
