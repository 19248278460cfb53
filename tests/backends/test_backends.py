"""Backends: which one does a call, what a wrong name is told, and that kernels pass their own check."""

import pickle
from dataclasses import replace
from typing import get_args

import pytest
import torch
from factories import random_camera, random_gaussians
from targets import CPU, SELDOM_INTERPRETED

import kgs
from kgs import RasterOptions, backends
from kgs.backends import get_backend
from kgs.backends.self_check import BOUND, EVERYTHING, FITS, largest_error
from kgs.fit.adam import Adam
from kgs.fit.config import Backend as BackendName
from kgs.init_points.matching import match
from kgs.losses import photometric_loss, target_moments

TORCH = backends.BACKENDS["torch"]
NAMES = r"\('auto', 'numba', 'torch', 'triton'\)"


class HalvingCompositor(TORCH.compositor):
    """Halves features."""

    def forward(self, inputs, keep):
        *others, features = inputs
        return super().forward((*others, features / 2), keep)


@pytest.fixture
def half(monkeypatch):
    """A backend before all others that halves features, for images of 12 columns at most, in tiles of 4."""
    backend = replace(TORCH, name="half", tile_size=4, max_width=12, compositor=HalvingCompositor)
    monkeypatch.setattr(backends, "BACKENDS", {"half": backend} | backends.BACKENDS)


def render(width, backend, **options):
    gaussians = random_gaussians(30, 0, sh_degree=None)
    return kgs.GaussianRenderer(backend=backend, **options)(gaussians, random_camera(8, width, 0)).image


def test_a_command_and_a_fit_take_every_name():
    assert set(get_args(BackendName)) == set(backends.available())


def test_auto_is_the_first_that_covers_the_call_and_torch_does_the_rest(half):
    assert backends.available() == ("auto", "half", "numba", "torch", "triton")
    assert torch.allclose(render(12, "auto"), render(12, "torch") / 2)
    assert torch.equal(render(12, "auto"), render(12, "half"))
    for width, options in ((13, {}), (12, {"tile_size": 5})):
        assert torch.equal(render(width, "auto", **options), render(width, "torch", **options))
        with pytest.raises(ValueError, match='for this call of compositing, got "half"'):
            render(width, "half", **options)


@pytest.mark.parametrize(("backend", "own"), [("half", 4), ("torch", 8)])
def test_the_tile_size_is_the_backends_own_unless_it_is_given(half, backend, own):
    projected = kgs.project(random_gaussians(30, 0, sh_degree=None), random_camera(8, 12, 0))
    for given in (None, own):
        out = kgs.composite(projected, projected.colors, options=RasterOptions(tile_size=given), backend=backend)
        assert out.tile_size == own


def test_a_table_is_handed_down_as_it_is_and_can_be_pickled():
    for name in ("auto", "torch"):
        table = get_backend(name, CPU)
        assert get_backend(table, torch.device("meta")) is table
        renderer = pickle.loads(pickle.dumps(kgs.GaussianRenderer(backend=table)))
        assert (renderer.backend.name, renderer.backend.is_named) == (table.name, name != "auto")


@pytest.mark.parametrize(
    ("name", "device", "said"),
    [
        ("numba", "cuda", '"torch" on cuda, got "numba", which runs on cpu alone; "triton" runs on cuda, too$'),
        ("triton", "mps", '"torch" on mps, got "triton", which runs on cuda and xpu alone$'),
        ("cuda", "cpu", f"expected one of {NAMES}, got 'cuda'"),
    ],
)
def test_a_name_that_does_not_fit_is_told_what_does(name, device, said, monkeypatch):
    monkeypatch.setattr("kgs.backends.table._is_found", lambda package: True)
    with pytest.raises(ValueError, match=f"^backend: .*{said}"):
        get_backend(name, torch.device(device))


@pytest.mark.parametrize(("is_there", "taken"), [(True, "numba"), (False, "torch")])
def test_auto_takes_the_place_of_what_is_not_required(is_there, taken, monkeypatch):
    """Matching and sweep have kernels for CPUs, also where the name is that of a backend of GPUs."""
    monkeypatch.setattr("kgs.backends.table._is_found", lambda package: is_there)
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    names = ("auto", "triton", "numba", "torch", "of the future")
    chosen = [get_backend(name, CPU, required=False).name for name in names]
    assert chosen == [*[taken] * 3, "torch", taken]


def points(dtype):
    return torch.rand(4, 3, dtype=dtype)


def footprints(dtype):
    return kgs.project(random_gaussians(3, 0, dtype), random_camera(12, 12, 0, dtype))


def images(dtype):
    return torch.rand(1, 3, 12, 12, dtype=dtype), torch.rand(1, 3, 12, 12, dtype=dtype)


STAGES = {
    "activation": lambda dtype, name: kgs.GaussianModel.from_points(points(dtype), points(dtype))(backend=name),
    "projection": lambda dtype, name: kgs.project(
        random_gaussians(3, 0, dtype), random_camera(12, 12, 0, dtype), backend=name
    ),
    "compositing": lambda dtype, name: kgs.composite(footprints(dtype), footprints(dtype).colors, backend=name),
    "loss": lambda dtype, name: photometric_loss(*images(dtype), backend=name),
    "moments": lambda dtype, name: target_moments(images(dtype)[0], backend=name),
    "optimizer": lambda dtype, name: Adam([{"params": [points(dtype)]}], backend=name),
    "matching": lambda dtype, name: match(
        points(dtype), points(dtype)[:, :2], *[points(dtype)] * 2, get_backend(name, CPU)
    ),
}


@pytest.mark.parametrize("stage", STAGES)
def test_float64_is_refused_by_name_and_left_to_torch_by_auto(stage, kernels):
    call = STAGES[stage]
    call(torch.float64, "auto")
    with pytest.raises(ValueError, match=f'for this call of .*, got "{kernels.backend}"'):
        call(torch.float64, kernels.backend)


def test_a_model_in_half_precision_is_refused():
    model = kgs.GaussianModel.from_points(points(torch.float32), points(torch.float32)).to(torch.bfloat16)
    with pytest.raises(TypeError, match="expected tensors of float32 or float64, got torch.bfloat16"):
        model()


@SELDOM_INTERPRETED
@pytest.mark.parametrize("cases", [(EVERYTHING,), FITS], ids=["everything", "fits"])
def test_training_steps_of_kernels_agree_with_torch(kernels, cases):
    assert largest_error(backends.BACKENDS[kernels.backend], kernels.device, cases) <= BOUND / 10
