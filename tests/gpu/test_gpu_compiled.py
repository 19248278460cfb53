"""What Triton makes of the kernels, for cards that are not there."""

import os
import subprocess
import sys

import pytest

from kgs.bench.compiled import CARDS, TARGETS, kernels

pytestmark = pytest.mark.slow


def test_the_kernels_of_a_training_step_compile_and_none_spills(tmp_path):
    compiler = pytest.importorskip("triton.compiler")
    if not hasattr(compiler, "ASTSource"):
        pytest.skip("another version of Triton")
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    subprocess.run([sys.executable, "-m", "kgs.bench.compiled", tmp_path], env=environment, check=True)
    rows = [line.split(",") for line in (tmp_path / "compiled.csv").read_text().splitlines()[1:]]
    assert {target for _, target, *_ in rows} == set(TARGETS)
    assert len(rows) == len(TARGETS) * len(kernels())
    assert not [row for row in rows if row[3] != "0"]
    tables = (tmp_path / "compiled.md").read_text()
    assert all(f"An estimate from below for one {card}" in tables for card in CARDS)


def test_every_form_of_every_kernel_compiles_and_none_spills():
    """Several cameras and their gradients, absolute gradients, median depths, features, row slices."""
    compiler = pytest.importorskip("triton.compiler")
    if not hasattr(compiler, "ASTSource"):
        pytest.skip("another version of Triton")
    names = [kernel.name for kernel in kernels()]
    program = (
        "from kgs.bench.compiled import build, kernels\n"
        "for kernel in kernels(every_form=True):\n"
        "    print(kernel.name, *(build(kernel, target).spills for target in ('sm_90', 'gfx942')))"
    )
    environment = {key: value for key, value in os.environ.items() if key != "TRITON_INTERPRET"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    found = [line.split() for line in done.stdout.splitlines()]
    assert {name for name, *_ in found} == set(names)
    assert len(found) >= len(names) + 8
    assert not [row for row in found if row[1:] != ["0", "0"]]


def test_the_oldest_version_that_torch_brings_draws_the_same(tmp_path):
    """Triton 3.2, of torch 2.6, in a folder before all others."""
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", tmp_path, "triton==3.2.0"]
    if subprocess.run(install, check=False).returncode:
        pytest.skip("there is no Triton 3.2 to install")
    program = (
        "import torch, triton\n"
        "from kgs.backends.gpu import GpuBackend; from kgs.backends.agreement import disagreement\n"
        "assert triton.__version__ == '3.2.0', triton.__version__\n"
        "print(disagreement(GpuBackend(), torch.device('cpu')))"
    )
    places = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"TRITON_INTERPRET": "1", "PYTHONPATH": places}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert float(done.stdout) <= 5e-6
