"""Training on Triton's kernels: when they are trusted, and how often a step calls the GPU and waits for it."""

import collections
import warnings

import pytest
import torch
from compiled_kernels import stages
from operators import Operators
from torch.utils._python_dispatch import _disable_current_modes

import kgs
from kgs.backends import get_backend
from kgs.backends.gpu import compositing, projection, trust
from kgs.datasets import synthetic_scene
from kgs.fit import FitConfig, Trainer
from kgs.fit.plan import make_plan
from kgs.init_points import InitialPoints

CPU = torch.device("cpu")
MAX_LAUNCHES, MAX_WAITS = 39, 1  # of a training step on a GPU
# operators that compute nothing, and those that wait for a number
_FREE = (
    "alias as_strided detach empty empty_like empty_strided expand lift_fresh new_empty permute reshape resize_ select"
)
_FREE += " slice split split_with_sizes squeeze t transpose unbind unsqueeze view _reshape_alias _unsafe_view"
_FREE += " _record_function_enter_new _record_function_exit"
_WAITS = ("_local_scalar_dense", "nonzero", "masked_select", "equal")


@pytest.fixture(scope="module")
def scene():
    """Two tiny pictures to train on, one to test."""
    return synthetic_scene(train_views=2, test_views=1, size=(12, 14), seed=1)


@pytest.fixture
def few(points):
    return InitialPoints(points.points[:20], points.colors[:20], "random")


def trainer(scene, points, backend, **options):
    return Trainer(
        scene, make_plan(scene, FitConfig(steps=50, sh_degree=1, backend=backend, **options), points), points
    )


@pytest.mark.slow
def test_a_step_is_few_launches_and_waits(scene, few, monkeypatch):
    fit = trainer(scene, few, "triton")
    fit._look_every = 20  # as on a GPU
    for _ in range(3):  # the first step with each view reads its camera, and the first of each turn their order
        fit.train_step()
    kernels, waits, real = collections.Counter(), [], torch.Tensor.tolist

    def launch(kernel, *arguments, **options):
        kernels[kernel] += 1
        with _disable_current_modes():
            launched(kernel, *arguments, **options)

    launched = compositing.launch
    for stage in stages():
        monkeypatch.setattr(stage, "launch", launch)
    monkeypatch.setattr(torch.Tensor, "tolist", lambda x: waits.append(1) or real(x))
    with Operators() as operators:
        fit.train_step()
    found = collections.Counter(operators.names)
    calls = sum(count for name, count in found.items() if name not in _FREE.split())
    waited = len(waits) + sum(found[name] for name in _WAITS)
    assert sum(kernels.values()) >= 10
    assert sum(kernels.values()) + calls <= MAX_LAUNCHES
    assert 1 <= waited <= MAX_WAITS


@pytest.mark.slow
def test_a_fit_by_kernels_is_that_of_torch_and_goes_on_without_them(scene, few, monkeypatch):
    fits = [trainer(scene, few, backend) for backend in ("triton", "torch")]
    for _ in range(3):
        ours, torchs = (fit.train_step() for fit in fits)
        assert ours == pytest.approx(torchs, rel=2e-5)
    ours, torchs = (fit.state_dict() for fit in fits)
    for name in ("means", "opacity_logits", "sh_dc"):  # gradients of round Gaussians to quats are rounding
        torch.testing.assert_close(ours["model"][name], torchs["model"][name], rtol=0.0, atol=1e-5)
        assert ours["optimizer"][name]["step"] == torchs["optimizer"][name]["step"] == 3.0
    assert torch.equal(ours["densifier"]["counts"], torchs["densifier"]["counts"])
    monkeypatch.delenv("TRITON_INTERPRET")
    resumed = trainer(scene, ours, "auto")
    assert resumed.plan.backend != "triton"
    assert resumed.train_step() == pytest.approx(fits[1].train_step(), rel=2e-5)


def test_a_resumed_fit_on_another_kind_of_device_draws_anew_and_says_so(scene, few):
    fit = trainer(scene, few, "torch")
    fit.train_step()
    state = fit.state_dict()
    state |= {"drop": state["drop"][:16], "colors": state["colors"][:16]}  # what a generator of a GPU has
    other = trainer(scene, few, "torch")
    other.load_state_dict(state)
    assert other.state.notes == [
        "the checkpoint is of another kind of device: dropping and backgrounds start new random sequences"
    ]
    assert other.train_step() > 0


def test_a_fit_that_looks_seldom_finds_what_is_not_finite_and_never_saves_it(scene, few, tmp_path):
    fit = trainer(scene, few, "torch")
    fit._look_every = 20
    fit.train_step()
    fit.save(tmp_path / "checkpoint.safetensors")
    with torch.no_grad():
        fit.model.means[3] = torch.nan
    with pytest.raises(kgs.TrainingDiverged, match="expected finite parameters, got .* in means of Gaussian 3"):
        fit.save(tmp_path / "checkpoint.safetensors")
    with pytest.raises(kgs.TrainingDiverged, match=r"step 20: expected finite parameters"):
        fit.fit()


# -- trust ---------------------------------------------------------------------------------------------------------


def test_auto_never_takes_the_interpreter():
    assert get_backend("auto", CPU).name in ("numba", "torch")
    assert get_backend("triton", CPU).name == "triton"
    assert not trust.is_trusted(CPU)


@pytest.fixture
def unchecked():
    trust.passes_check.cache_clear()
    yield
    trust.passes_check.cache_clear()


@pytest.mark.usefixtures("unchecked")
def test_kernels_that_fail_are_not_used_and_a_line_says_so(monkeypatch):
    def launch(*_, **__):
        try:
            1 / 0  # noqa: B018
        except ZeroDivisionError as error:
            raise RuntimeError("at 3:4:") from error  # as Triton's compiler, which points at the line of a kernel

    monkeypatch.setattr(projection, "launch", launch)
    with pytest.warns(UserWarning, match="Triton's kernels are not used on cpu, torch is: ZeroDivisionError"):
        assert not trust.passes_check(CPU)
    with warnings.catch_warnings():  # once
        warnings.simplefilter("error")
        assert not trust.passes_check(CPU)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_kernels_that_differ_are_not_used_and_a_line_says_so(monkeypatch):
    monkeypatch.setattr(compositing, "FEATURES", 2)  # blocks of four overlap: what they say is added up twice
    with pytest.warns(UserWarning, match=r"they differ from torch by .*, more than 5e-05"):
        assert not trust.passes_check(CPU)


def test_without_triton_a_clear_error(monkeypatch):
    monkeypatch.setattr("kgs.backends.table._is_found", lambda package: False)
    with pytest.raises(ModuleNotFoundError, match='"triton" needs triton, torch brings it on Linux'):
        kgs.GaussianRenderer(backend="triton")
