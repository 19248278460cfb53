"""What is compiled before it is launched: which kernels, all of them at once, and what the log says meanwhile."""

import logging
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from kgs.backends import self_check
from kgs.backends.gpu import TRITON, compiling
from kgs.backends.gpu import launch as launching
from kgs.backends.gpu.compiling import compile_together, needed_launches
from kgs.backends.gpu.launch import Launch
from kgs.bench.speed import Cases

CPU = torch.device("cpu")


def integers_left_aside(kernel):
    """As `launch._not_specialized`, of kernels in the interpreter."""
    names = kernel.kwargs["do_not_specialize"] or ()
    return tuple(name in names for name in kernel.arg_names)


@pytest.fixture(autouse=True)
def _interpreted_keys(monkeypatch):
    monkeypatch.setattr(launching, "_not_specialized", integers_left_aside)


def forms(run):
    return {launch.key: (launch.kernel.fn.__name__, launch.constants) for launch in needed_launches(run)}


def cases(size, count, absgrad=False, degree=3):
    found = Cases(count, size, CPU, "triton")
    found.renderer.options = replace(found.renderer.options, absgrad=absgrad)
    found.model.sh_degree = degree
    return found


def test_a_training_step_needs_no_kernel_that_the_check_does_not():
    """Whatever the number of Gaussians and the size of the image, divisible by 16 or not."""
    checked = forms(lambda: self_check.run_stages(TRITON, CPU, self_check.FITS))
    names = {name for name, _ in checked.values()}
    assert len(names) >= 26
    assert len(checked) <= len(names) + 8
    runs = [
        cases((24, 32), 100).train,
        cases((32, 16), 48, absgrad=True).train,
        cases((21, 31), 1, degree=0).train,
        cases((21, 32), 50, degree=0).forward,
    ]
    for run in runs:
        missing = {key: form for key, form in forms(run).items() if key not in checked}
        assert not missing.values()


def test_several_cameras_need_one_form_of_each_kernel_and_its_constants():
    found = forms(lambda: self_check.run_stages(TRITON, CPU, (self_check.EVERYTHING,)))
    names = [(name, *constants.items()) for name, constants in found.values()]
    assert len(names) == len(set(names))


def test_what_is_needed_is_found_without_launching(monkeypatch):
    monkeypatch.setattr("triton.runtime.interpreter.InterpretedFunction.__getitem__", lambda *_: 1 / 0)
    found = needed_launches(lambda: self_check.run_stages(TRITON, CPU, (self_check.EVERYTHING,)))
    assert "composite_backward" in {launch.kernel.fn.__name__ for launch in found}
    with pytest.raises(ZeroDivisionError):
        self_check.run_stages(TRITON, CPU, (self_check.EVERYTHING,))


# -- with kernels that only record --------------------------------------------------------------------------------


class Kernel:
    """What is compiled, and where its compiler waits."""

    cache_key = "key"

    def __init__(self, begin=None):
        self.begin = begin
        self.calls = []
        self.loaded = 0

    def warmup(self, *arguments, **options):
        self.calls.append((arguments, options))
        if self.begin is not None:
            self.begin()
        return self

    @property
    def run(self):
        self.loaded += 1


def called(kernel):
    return Launch(kernel, (3,), (torch.zeros(2), 5), 1, {"BLOCK": 8})


@pytest.fixture(autouse=True)
def _no_driver(monkeypatch):
    driver = SimpleNamespace(active=SimpleNamespace(get_current_device=lambda: 0))
    monkeypatch.setattr(compiling, "triton", SimpleNamespace(runtime=SimpleNamespace(driver=driver)))


def test_kernels_are_compiled_at_once_with_what_they_are_launched_with(monkeypatch):
    monkeypatch.setattr(compiling, "cores", lambda: 4)
    together = threading.Barrier(4)
    kernels = [Kernel(lambda: together.wait(timeout=30)) for _ in range(4)]
    compile_together([called(kernel) for kernel in kernels], CPU)
    for kernel in kernels:
        ((arguments, options),) = kernel.calls
        assert arguments[1] == 5
        assert options == {"grid": (3,), "BLOCK": 8, "num_warps": 1, "enable_fp_fusion": True}
        assert kernel.loaded == 1
    compile_together([], CPU)


def test_one_that_cannot_be_compiled_is_left_out():
    kernels = [Kernel(lambda: 1 / 0), Kernel()]
    compile_together([called(kernel) for kernel in kernels], CPU)
    assert [kernel.loaded for kernel in kernels] == [0, 1]


def test_what_goes_wrong_meanwhile_is_no_error(monkeypatch, caplog):
    monkeypatch.delenv("TRITON_INTERPRET")
    devices = []
    with caplog.at_level(logging.DEBUG, "kgs"):
        TRITON.compile_ahead(lambda device: devices.append(device) or 1 / 0, torch.device("cuda", 0))
    assert devices == [CPU]
    assert "ZeroDivisionError" in caplog.text
