"""`--device` and `--backend`: what auto takes, what is said of it, and what a resumed fit goes on with."""

import inspect
import logging
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from command import one_line, run
from refusals import refused

from kgs import DataError, backends
from kgs._support.json_files import write_json
from kgs.app.cli import tools
from kgs.app.cli.run import COMMANDS, load_command
from kgs.app.files.fit_files import CHECKPOINT, UNFINISHED
from kgs.app.files.results import MARKER
from kgs.fit import FitConfig, Trainer
from kgs.fit.plan import make_plan

QUICK = ("--init", "random", "--init-points", 30, "--evaluations", 1)


@pytest.fixture
def card(monkeypatch):
    """A machine with a GPU: which packages it has, and whether its kernels are trusted."""

    machine = SimpleNamespace(packages={"numba", "triton"}, trust=lambda _: True)
    torchs = backends.BACKENDS["torch"]
    numba = replace(torchs, name="numba", devices=("cpu",), package=("numba", "fast"))
    triton = replace(torchs, name="triton", devices=("cuda",), package=("triton", "torch brings it"))
    triton = replace(triton, is_trusted=lambda device: machine.trust(device))
    monkeypatch.setattr(backends, "BACKENDS", {"numba": numba, "triton": triton, "torch": torchs})
    monkeypatch.setattr("kgs.backends.table._is_found", lambda package: package in machine.packages)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda _: "Card 9000")
    monkeypatch.setattr("kgs._support.machine.check_device", torch.device)
    return machine


@pytest.mark.parametrize(
    ("backend", "numba", "kernels", "taken", "said"),
    [
        ("auto", True, "right", "cuda", ""),
        ("auto", False, "right", "cuda", ""),
        ("auto", True, "wrong", "cpu", "kgs: the CPU is used: --device cuda takes the GPU, with torch's operators"),
        ("auto", True, "missing", "cpu", "kgs: the CPU is used: --device cuda takes the GPU, with torch's operators"),
        ("auto", False, "wrong", "cuda", ""),  # torch's operators do the work on either
        ("torch", True, "wrong", "cuda", ""),
        ("triton", True, "wrong", "cuda", ""),  # that is how to try them
        ("numba", True, "right", "cpu", ""),
    ],
)
def test_auto_takes_a_gpu_for_which_there_are_kernels(card, backend, numba, kernels, taken, said, capsys):
    there = {"numba": numba, "triton": kernels != "missing"}
    card.packages = {package for package, is_there in there.items() if is_there}
    card.trust = lambda _: kernels == "right"
    assert tools.load_tools("auto", backend).type == taken
    lines = capsys.readouterr().err
    assert lines.startswith(said)
    assert len(lines.splitlines()) == bool(said)


def test_auto_is_the_cpu_without_a_gpu_and_with_one_that_cannot_be_used(card, monkeypatch, capsys):
    def broken(name):
        raise ValueError(f"device: expected cpu or a GPU of this machine, got {name!r} (all of it is taken)")

    monkeypatch.setattr("kgs._support.machine.check_device", broken)
    assert tools.load_tools("auto").type == "cpu"
    assert "the CPU is used: device: expected" in one_line(capsys)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert tools.load_tools("auto").type == "cpu"
    assert not capsys.readouterr().err
    with pytest.raises(ValueError, match='backend: expected "auto" or "torch" on cpu, got "triton"'):
        tools.load_tools("auto", "triton")


def test_a_line_of_a_command_says_why_the_first_use_of_a_gpu_takes_long(card, monkeypatch, capsys):
    log = logging.getLogger("kgs")
    before = log.level, list(log.handlers)
    card.trust = lambda _: log.info("compiling: %d of %d", 12, 27) or True
    tools.load_tools("auto")
    assert capsys.readouterr() == ("", "")  # of the library
    monkeypatch.setitem(COMMANDS, "check", lambda: tools.load_tools("cuda") and 0)
    monkeypatch.setattr("kgs.app.cli.run.load_command", COMMANDS.get)
    assert run("check") == 0
    assert capsys.readouterr() == ("", "kgs: compiling: 12 of 27\n")
    assert (log.level, log.handlers) == before


def test_auto_is_the_default_of_all_commands():
    defaults = {}
    for name in COMMANDS:
        parameters = inspect.signature(load_command(name)).parameters
        if "device" in parameters:
            defaults[name] = parameters["device"].default
    assert defaults.pop("check") is None  # the CPU and all GPUs
    assert {*defaults} >= {"demo", "render", "eval", "page", "clean", "bench speed"}
    assert {*defaults.values()} == {"auto"}


@pytest.mark.parametrize(("begun", "taken"), [("cpu", "cpu"), ("cpu:0", "cpu"), ("cuda", "cuda"), (None, "cuda")])
def test_a_fit_of_a_cpu_goes_on_there_where_there_is_a_gpu_too(
    card, folder, tmp_path, capsys, monkeypatch, begun, taken
):
    """With --device auto: on a GPU a resumed fit has other bits."""
    work = tmp_path / "out" / UNFINISHED
    work.mkdir(parents=True)
    if begun is not None:
        (work / CHECKPOINT).touch()
        write_json(work / "config.json", {"fit": {"device": begun}})
    write_json(work.parent / MARKER, {"files": {}})
    monkeypatch.setattr("kgs.app.fit_folder.fit_folder", lambda *_, **__: (_ for _ in ()).throw(SystemExit(7)))
    for options, expected in ((("--resume",), taken), (("--resume", "--device", "cuda"), "cuda"), ((), "cuda")):
        out = tmp_path / ("out" if "--resume" in options else "new")
        assert run("fit", folder, "-o", out, *options, *QUICK) == 7
        named = capsys.readouterr().out.splitlines()[0]
        assert named.startswith("device: CPU, " if expected == "cpu" else "device: Card 9000 (cuda)")


@pytest.mark.parametrize(("begun", "other"), [("torch", "numba"), ("numba", "torch")])
def test_a_resumed_fit_goes_on_with_the_backend_it_was_begun_with(card, scene, points, tmp_path, begun, other):
    config = FitConfig(steps=3, evaluations=1, init="random", init_points=50, backend=begun)
    trainer = Trainer(scene, make_plan(scene, config, points), points)
    trainer.train_step()
    trainer.save(tmp_path / CHECKPOINT)
    for asked in ("auto", begun):
        resumed = Trainer.resume(scene, replace(config, backend=asked), tmp_path / CHECKPOINT)
        assert (resumed.plan.backend, resumed.renderer.backend.name) == (begun, begun)
    with refused(DataError, path=tmp_path / CHECKPOINT, key="backend"):
        Trainer.resume(scene, replace(config, backend=other), tmp_path / CHECKPOINT)
