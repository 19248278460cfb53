"""The registry of stages: who runs what, and what a wrong name is told."""

import pytest
import torch
from factories import random_camera, random_gaussians

import kgs
from kgs import backends


@pytest.fixture
def half(monkeypatch):
    """A backend that halves features, for images of 8 rows at most; it has no projection of its own."""
    stages = {stage: dict(there) for stage, there in backends._registry.items()}
    monkeypatch.setattr(backends, "_registry", stages)

    def run(projected, features, *rest):
        return backends.choose("compositing", "torch", projected, features, *rest)(projected, features / 2, *rest)

    backends.register("compositing", "half", run, lambda projected, *_: projected.image_size[0] <= 8)


def render(rows, backend):
    gaussians = random_gaussians(30, 0, sh_degree=None)  # float64: torch
    return kgs.GaussianRenderer(backend=backend)(gaussians, random_camera(rows, 12, 0)).image


def test_auto_is_torch_where_nothing_else_covers_the_call():
    assert backends.available() == ("auto", "numba", "torch")
    assert torch.equal(render(8, "auto"), render(8, "torch"))


def test_auto_takes_what_covers_the_call_and_torch_takes_the_rest(half):
    assert backends.available() == ("auto", "half", "numba", "torch")
    assert torch.allclose(render(8, "auto"), render(8, "torch") / 2)
    assert torch.equal(render(8, "auto"), render(8, "half"))
    assert torch.equal(render(9, "auto"), render(9, "torch"))


def test_a_backend_by_name_is_refused_where_it_does_not_cover_the_call(half):
    with pytest.raises(ValueError, match=r"backend: 'half' does not cover this call of compositing"):
        render(9, "half")


@pytest.mark.parametrize("make", [kgs.GaussianRenderer, lambda backend: render(8, backend)])
def test_an_unknown_backend_is_told_what_there_is(make):
    with pytest.raises(ValueError, match=r"backend: expected one of \('auto', 'numba', 'torch'\), got 'cuda'"):
        make(backend="cuda")


def test_an_unknown_stage_is_refused():
    with pytest.raises(ValueError, match="stage: expected one of"):
        backends.register("lists", "torch", print)
