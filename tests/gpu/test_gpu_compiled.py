"""What Triton makes of the kernels, for cards that are not there."""

import os
import subprocess
import sys

import pytest
from compiled_kernels import TARGETS, recorded_kernels, spilled_bytes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def kernels():
    """The kernels of a training step, and all forms of them."""
    compiler = pytest.importorskip("triton.compiler")
    if not hasattr(compiler, "ASTSource"):
        pytest.skip("another version of Triton")
    return {"training step": recorded_kernels(), "every form": recorded_kernels(every_form=True)}


@pytest.mark.parametrize("target", TARGETS)
def test_the_kernels_of_a_training_step_compile_and_none_spills(kernels, target):
    spilled = spilled_bytes(kernels["training step"], target)
    assert len(spilled) == len(kernels["training step"]) >= 21
    assert not [pair for pair in spilled if pair[1] != 0]


@pytest.mark.parametrize("target", ["sm_90", "gfx942"])
def test_every_form_of_every_kernel_compiles_and_none_spills(kernels, target):
    """Several cameras and their gradients, absolute gradients, median depths, features, row slices, backgrounds."""
    spilled = spilled_bytes(kernels["every form"], target)
    names = {kernel["name"] for kernel in kernels["training step"]}
    others = {"count_entries", "blend_color", "color_gradient"}  # of several cameras, row slices and backgrounds
    assert {name for name, _ in spilled} == names | others
    assert len(spilled) >= len(names) + 8
    assert not [pair for pair in spilled if pair[1] != 0]


def test_the_oldest_version_that_torch_brings_draws_the_same(tmp_path):
    """Triton 3.2, of torch 2.6, in a folder before all others."""
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", tmp_path, "triton==3.2.0"]
    if subprocess.run(install, check=False).returncode:
        pytest.skip("there is no Triton 3.2 to install")
    program = (
        "import torch, triton\n"
        "from kgs.backends.gpu import TRITON; from kgs.backends.self_check import largest_error\n"
        "assert triton.__version__ == '3.2.0', triton.__version__\n"
        "print(largest_error(TRITON, torch.device('cpu')))"
    )
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert float(done.stdout) <= 5e-6
