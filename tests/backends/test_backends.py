"""Backends: which one runs a call, what a wrong name is told, and that kernels agree with torch."""

import pytest
import torch
from factories import random_camera, random_gaussians
from targets import SELDOM_INTERPRETED

import kgs
from kgs import RasterOptions, backends
from kgs.backends.agreement import BOUND, EVERYTHING, FITS, disagreement


class Half(backends.TorchBackend):
    """Halves features, for images of 8 rows at most, in tiles of 4."""

    name = "half"
    tile_size = 4

    def covers_compositing(self, call):
        return call.projected.image_size[0] <= 8

    @property
    def compositor(self):
        class Halved(super().compositor):
            def forward(self, inputs, keep):
                return super().forward(inputs._replace(features=inputs.features / 2), keep)

        return Halved


@pytest.fixture
def half(monkeypatch):
    monkeypatch.setattr(backends, "BACKENDS", (Half(), *backends.BACKENDS))


def render(rows, backend, **options):
    gaussians = random_gaussians(30, 0, sh_degree=None)  # float64: torch
    return kgs.GaussianRenderer(backend=backend, **options)(gaussians, random_camera(rows, 12, 0)).image


def test_auto_is_torch_where_nothing_else_covers_the_call():
    assert backends.available() == ("auto", "numba", "torch", "triton")
    assert torch.equal(render(8, "auto"), render(8, "torch"))


def test_auto_takes_what_covers_the_call_and_torch_takes_the_rest(half):
    assert backends.available() == ("auto", "half", "numba", "torch", "triton")
    assert torch.allclose(render(8, "auto"), render(8, "torch") / 2)
    assert torch.equal(render(8, "auto"), render(8, "half"))
    assert torch.equal(render(9, "auto"), render(9, "torch"))


def test_the_error_about_a_device_names_all_that_run_there():
    with pytest.raises(ValueError, match='"torch" on cuda, got "numba", which runs on cpu alone; "triton" runs on'):
        backends.resolve("numba", torch.device("cuda"))
    with pytest.raises(ValueError, match='"torch" on mps, got "triton", which runs on cuda and xpu alone$'):
        backends.resolve("triton", torch.device("mps"))


@pytest.mark.parametrize(("backend", "own"), [("half", 4), ("torch", 8)])
def test_the_tile_size_is_the_backends_own_unless_it_is_given(half, backend, own):
    projected = kgs.project(random_gaussians(30, 0, sh_degree=None), random_camera(8, 12, 0))
    for given, used in ((None, own), (5, 5)):
        out = kgs.composite(projected, projected.colors, options=RasterOptions(tile_size=given), backend=backend)
        assert out.tile_size == used


def test_a_backend_by_name_is_refused_where_it_does_not_cover_the_call(half):
    with pytest.raises(ValueError, match=r"for this call of compositing, got 'half'"):
        render(9, "half")


@pytest.mark.parametrize("make", [kgs.GaussianRenderer, lambda backend: render(8, backend)])
def test_an_unknown_backend_is_told_what_there_is(make):
    with pytest.raises(
        ValueError, match=r"backend: expected one of \('auto', 'numba', 'torch', 'triton'\), got 'cuda'"
    ):
        make(backend="cuda")


def test_kernels_beside_the_renderer_are_numbas_unless_torch_is_named(half):
    pytest.importorskip("numba")
    rows = torch.zeros(3, 2)
    takes = {name: backends.takes_kernels(name, "rows", rows) for name in backends.available()}
    assert takes == {"auto": True, "half": True, "numba": True, "torch": False, "triton": True}
    assert not backends.takes_kernels("auto", "rows", rows.double())
    with pytest.raises(ValueError, match="for this call of rows, got 'numba'"):
        backends.takes_kernels("numba", "rows", rows.double())


@SELDOM_INTERPRETED
@pytest.mark.parametrize("steps", [(EVERYTHING,), FITS], ids=["everything", "fits"])
def test_training_steps_of_kernels_agree_with_torch(kernels, steps):
    backend = next(x for x in backends.BACKENDS if x.name == kernels.backend)
    assert disagreement(backend, kernels.device, steps) <= BOUND / 10
