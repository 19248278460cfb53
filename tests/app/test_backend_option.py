"""`backend` of fits and commands: what "auto" became is kept, and a fit goes on with what it was begun with."""

from dataclasses import replace

import pytest
import torch
from fits_in_folders import fit_in

from kgs import DataError, backends
from kgs._support.json_files import read_json
from kgs.app.files.fit_files import CHECKPOINT
from kgs.app.saved_fit import load_fit
from kgs.app.scene_request import SceneRequest
from kgs.backends import get_backend
from kgs.fit import FitConfig, Trainer
from kgs.fit.plan import make_plan
from kgs.fit.pruning import prune

CONFIG = FitConfig(steps=3, evaluations=1, init="random", init_points=50)


@pytest.fixture
def installed(monkeypatch):
    """A "numba" that is torch under another name; sets whether it is installed."""

    torchs = backends.BACKENDS["torch"]
    numba = replace(torchs, name="numba", devices=("cpu",), package=("numba", "fast"))
    monkeypatch.setattr(backends, "BACKENDS", {"numba": numba, "torch": torchs})

    def set_installed(there):
        monkeypatch.setattr("kgs.backends.table._is_found", lambda package: there)

    set_installed(True)
    return set_installed


def test_auto_is_numba_where_it_is_installed_and_the_device_is_a_cpu(installed):
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    assert [get_backend("auto", device).name for device in (cpu, gpu)] == ["numba", "torch"]
    assert [get_backend(name, cpu).name for name in ("torch", "numba")] == ["torch", "numba"]
    with pytest.raises(ValueError, match='backend: expected "auto" or "torch" on cuda, got "numba"'):
        get_backend("numba", gpu)
    former = [get_backend(name, cpu, required=False).name for name in ("numba", "torch", "triton")]
    assert former == ["numba", "torch", "numba"]
    assert get_backend("numba", gpu, required=False).name == "torch"
    installed(False)
    assert get_backend("auto", cpu).name == "torch"
    with pytest.raises(ModuleNotFoundError, match="numba"):
        get_backend("numba", cpu)
    assert get_backend("numba", cpu, required=False).name == "torch"  # a fit is shown where its backend is not there


@pytest.mark.parametrize(("asked", "made"), [("auto", "numba"), ("torch", "torch")])
def test_the_choice_is_kept_with_the_results(installed, scene, tmp_path, monkeypatch, asked, made):
    monkeypatch.setattr(SceneRequest, "load", lambda *_: scene)
    published = fit_in(scene, replace(CONFIG, backend=asked), tmp_path, SceneRequest("somewhere"))
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
        assert (resumed.plan.backend, resumed.renderer.backend.name) == (begun, begun)
    with pytest.raises(DataError, match=f"backend: expected '{begun}', as the fit was begun with, got '{other}'"):
        Trainer.resume(scene, replace(CONFIG, backend=other), tmp_path / CHECKPOINT)
