"""Compile the Triton kernels for cards that are not there. A script, because each half needs a process of its own:

python compiled_kernels.py record [all]     in Triton's interpreter: print the kernels that a step calls, as JSON
python compiled_kernels.py build TARGET     without it: compile these from stdin, print names and bytes spilled
"""

import json
import os
import pkgutil
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import torch

from kgs.backends import gpu
from kgs.backends.gpu import launch as gpu_launch
from kgs.bench.scenes import layered_scene
from kgs.bench.speed import Cases
from kgs.densify import Densifier
from kgs.geometry.cameras import pinhole_cameras
from kgs.renderer import GaussianRenderer

TARGETS = {
    "sm_75": ("cuda", 75, 32),
    "sm_80": ("cuda", 80, 32),
    "sm_90": ("cuda", 90, 32),
    "sm_120": ("cuda", 120, 32),
    "gfx942": ("hip", "gfx942", 64),
    "gfx1100": ("hip", "gfx1100", 32),
}
_TYPES = {"float32": "*fp32", "int64": "*i64", "int32": "*i32", "int16": "*i16", "int8": "*i8"}


def stages():
    """The modules that launch kernels."""
    names = [module.name for module in pkgutil.iter_modules(gpu.__path__) if module.name != "launch"]
    modules = [import_module(f"kgs.backends.gpu.{name}") for name in names]
    return [module for module in modules if hasattr(module, "launch")]


def recorded_kernels(every_form=False):
    """The kernels of a training step, as dicts: module, name, signature, constants and warps.

    With `every_form` also the forms that other calls use: several cameras, their gradients, features, row slices.
    """
    return _run(["record", *(["all"] if every_form else [])], os.environ | {"TRITON_INTERPRET": "1"})


def spilled_bytes(kernels, target):
    """Compile the kernels for a target; pairs of a kernel's name and the bytes that it spills."""
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    return [tuple(pair) for pair in _run(["build", target], environment, json.dumps(kernels))]


def _run(words, environment, given=""):
    """Run this script, and read the JSON of its last line."""
    command = [sys.executable, __file__, *words]
    done = subprocess.run(command, env=environment, input=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


# -- in the interpreter --------------------------------------------------------------------------------------------


def _record(every_form):
    recorded = {}

    def launch(kernel, grid, *arguments, warps=4, **constants):
        names = [name for name in kernel.arg_names if name not in constants]
        values = dict(zip(names, arguments, strict=True))
        not_specialized = kernel.kwargs["do_not_specialize"] or ()
        # Triton takes an argument of 1 for a constant.
        ones = {name: 1 for name, value in values.items() if type(value) is int and value == 1}
        ones = {name: value for name, value in ones.items() if name not in not_specialized}
        signature = {name: _type_of(value) for name, value in values.items() if name not in ones}
        name = kernel.fn.__name__
        form = (name, *sorted((constants | ones).items())) if every_form else name
        recorded[form] = {
            "module": kernel.fn.__module__,
            "name": name,
            "signature": signature,
            "constants": constants | ones,
            "warps": warps,
        }
        interpret(kernel, grid, *arguments, warps=warps, **constants)

    interpret = gpu_launch.launch
    for stage in stages():
        stage.launch = launch
    cases = Cases(40, (16, 16), torch.device("cpu"), "triton")
    cases.train()
    _densify(cases)
    if every_form:
        _render_every_form()
    return list(recorded.values())


def _densify(cases):
    """What a fit calls for densification."""
    densifier = Densifier(cases.model, cases.optimizer, 1.0, backend="triton")
    rendering = cases.renderer(cases.model(), cases.camera)
    rendering.projected.means2d.retain_grad()
    rendering.image.sum().backward()
    densifier.observe(rendering.projected)
    densifier.decay_opacity(0.5)


def _render_every_form():
    """Renders that a training step does not ask for."""
    model, camera = layered_scene(40, (24, 24))
    for degree in range(4):
        model.sh_degree = degree
        sum(x.sum() for x in vars(model(backend="triton")).values()).backward()
    gaussians = model()
    leaves = {name: value.detach().requires_grad_() for name, value in vars(gaussians).items()}
    single = replace(gaussians, **leaves)
    pose = camera.extrinsics.repeat(2, 1, 1).requires_grad_()
    cameras = pinhole_cameras(pose, camera.intrinsics[0], 24, 24)
    per_camera = replace(single, opacities=single.opacities.repeat(2, 1))
    for some, max_bytes in ((single, 2**17), (per_camera, 2**30)):
        renderer = GaussianRenderer(backend="triton", absgrad=True, max_bytes=max_bytes)
        renderer(some, cameras, torch.rand(3), ("image", "median_depth")).image.square().sum().backward()
    features = replace(single, colors=torch.rand(40, 9, requires_grad=True))
    GaussianRenderer(backend="triton")(features, cameras).image.square().sum().backward()


def _type_of(argument):
    if isinstance(argument, torch.Tensor):
        return _TYPES[str(argument.dtype).removeprefix("torch.")]
    return "i32" if isinstance(argument, int) else "fp32"


# -- with the compiler ---------------------------------------------------------------------------------------------


def _spills(kernel, target):
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    function = getattr(import_module(kernel["module"]), kernel["name"])
    signature = {name: kernel["signature"].get(name, "constexpr") for name in function.arg_names}
    constants = {name: kernel["constants"][name] for name in function.arg_names if name not in kernel["signature"]}
    source = ASTSource(fn=function, signature=signature, constexprs=constants)
    options = {"num_warps": kernel["warps"], "enable_fp_fusion": True}
    code = triton.compile(source, target=GPUTarget(*TARGETS[target]), options=options).asm
    if "amdgcn" in code:
        return 4 * int(re.search(r"\.vgpr_spill_count:\s+(\d+)", code["amdgcn"])[1])
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        Path(file.name).write_bytes(code["cubin"])
        use = subprocess.run([tool, "-res-usage", file.name], capture_output=True, check=True, text=True).stdout
    return int(re.search(r"STACK:(\d+)", use)[1])


if __name__ == "__main__":
    if sys.argv[1] == "record":
        print(json.dumps(_record(every_form="all" in sys.argv)))
    else:
        print(json.dumps([(kernel["name"], _spills(kernel, sys.argv[2])) for kernel in json.load(sys.stdin)]))
