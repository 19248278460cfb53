"""`backend` of fits and commands: what "auto" became is kept, and a fit goes on with what it was begun with."""

from dataclasses import replace

import pytest
import torch

from kgs import DataError, backends
from kgs._support.json_files import read_json
from kgs.app.files.results_folder import CHECKPOINT
from kgs.app.fit_folder import fit_folder
from kgs.app.saved_fit import load_fit
from kgs.app.scene_request import SceneRequest
from kgs.fit import FitConfig, Trainer
from kgs.fit.plan import make_plan
from kgs.fit.pruning import prune

CONFIG = FitConfig(steps=3, evaluations=1, init="random", init_points=50)


@pytest.fixture
def installed(monkeypatch):
    """A "numba" that is torch under another name; sets whether it is installed."""

    class Numba(backends.TorchBackend):
        name, devices, package = "numba", ("cpu",), ("numba", "fast")

        def covers(self, like):
            return self.is_installed()

    numba = Numba()
    monkeypatch.setattr(backends, "BACKENDS", (numba, backends.TorchBackend()))

    def set_installed(there):
        monkeypatch.setattr(numba, "is_installed", lambda: there)

    set_installed(True)
    return set_installed


def test_auto_is_numba_where_it_is_installed_and_the_device_is_a_cpu(installed):
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert [backends.resolve("auto", device) for device in (cpu, gpu)] == ["numba", "torch"]
    assert [backends.resolve(name, cpu) for name in ("torch", "numba")] == ["torch", "numba"]
    with pytest.raises(ValueError, match='backend: expected "auto" or "torch" on cuda, got "numba"'):
        backends.resolve("numba", gpu)
    former = [backends.former_or_auto(name, cpu) for name in ("numba", "torch", "triton")]
    assert former == ["numba", "torch", "auto"]
    assert backends.former_or_auto("numba", gpu) == "auto"
    installed(False)
    assert backends.resolve("auto", cpu) == "torch"
    with pytest.raises(ModuleNotFoundError, match="numba"):
        backends.resolve("numba", cpu)
    assert backends.former_or_auto("numba", cpu) == "auto"  # a fit is shown where its backend is not there


@pytest.mark.parametrize(("asked", "made"), [("auto", "numba"), ("torch", "torch")])
def test_the_choice_is_kept_with_the_results(installed, scene, tmp_path, monkeypatch, asked, made):
    monkeypatch.setattr(SceneRequest, "load", lambda *_: scene)
    published = fit_folder(scene, replace(CONFIG, backend=asked), tmp_path, SceneRequest("somewhere"))
    assert published.fit.metrics["backend"] == made
    assert read_json(tmp_path / "config.json")["fit"]["backend"] == asked
    fit = load_fit(tmp_path)[1]
    assert fit.backend == made
    camera = scene.test.camera(0)
    resumed = Trainer.resume(scene, CONFIG, tmp_path / CHECKPOINT).fit()
    assert torch.equal(fit.render(camera), prune(resumed).render(camera))


@pytest.mark.parametrize(("begun", "other"), [("torch", "numba"), ("numba", "torch")])
def test_a_resumed_fit_goes_on_with_what_it_was_begun_with(installed, scene, points, tmp_path, begun, other):
    trainer = Trainer(scene, make_plan(scene, replace(CONFIG, backend=begun), points), points)
    trainer.train_step()
    trainer.save(tmp_path / CHECKPOINT)
    for asked in ("auto", begun):
        resumed = Trainer.resume(scene, replace(CONFIG, backend=asked), tmp_path / CHECKPOINT)
        assert (resumed.plan.backend, resumed.renderer.backend) == (begun, begun)
    with pytest.raises(DataError, match=f"backend: expected '{begun}', as the fit was begun with, got '{other}'"):
        Trainer.resume(scene, replace(CONFIG, backend=other), tmp_path / CHECKPOINT)
