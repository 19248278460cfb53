"""The dataclasses check shapes, dtypes and devices, name the culprit, and never look at values."""

import dataclasses
import inspect

import numpy as np
import pytest
import torch

import kgs
import kgs.reference
from kgs import Gaussians
from kgs.geometry.harmonics import evaluate_harmonics


def fields(n=5, bands=4, dtype=torch.float32):
    return {
        "means": torch.zeros(n, 3, dtype=dtype),
        "quats": torch.zeros(n, 4, dtype=dtype),
        "scales": torch.ones(n, 3, dtype=dtype),
        "opacities": torch.ones(n, dtype=dtype),
        "colors": torch.zeros(n, bands, 3, dtype=dtype),
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bands", [1, 4, 9, 16])
@pytest.mark.parametrize("n", [0, 5])
def test_harmonics_of_degree_0_to_3_are_taken(n, bands, dtype):
    gaussians = Gaussians(**fields(n, bands, dtype))
    assert len(gaussians) == n
    assert gaussians, "true as a model is, also where n is 0"
    assert evaluate_harmonics(gaussians.colors, torch.ones(n, 3, dtype=dtype)).shape == (n, 3)


@pytest.mark.parametrize(("name", "shape"), [("colors", (5, 3)), ("colors", (5, 7)), ("opacities", (2, 5))])
def test_other_shapes_that_are_meant(name, shape):
    Gaussians(**fields() | {name: torch.zeros(shape)})


def test_the_tensors_are_kept_as_they_are_and_fields_cannot_be_set():
    given = fields()
    gaussians = Gaussians(**given)
    assert all(getattr(gaussians, name) is value for name, value in given.items())
    with pytest.raises(dataclasses.FrozenInstanceError):
        gaussians.means = given["means"]


def test_values_are_not_checked():
    given = {name: torch.full_like(value, torch.nan) for name, value in fields().items()}
    Gaussians(**given)
    Gaussians(**fields() | {"opacities": torch.full((5,), 1.25), "scales": -torch.ones(5, 3)})


WRONG_SHAPES = {
    "means": [(5, 2), (3,), (), (1, 5, 3)],
    "quats": [(5, 3), (4, 4)],
    "scales": [(5,), (5, 1)],
    "opacities": [(4,), (5, 1), (), (1, 2, 5)],
    "colors": [(5,), (4, 3), (5, 3, 4), (5, 5, 3), (5, 25, 3), (5, 0, 3), (6, 4, 3)],
}
WRONG_DTYPES = (torch.float16, torch.bfloat16, torch.int64, torch.complex64)


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_wrong_shapes_types_dtypes_and_devices_name_the_argument(name):
    given = fields()
    right = given[name]
    wrong = [(ValueError, torch.zeros(shape)) for shape in WRONG_SHAPES[name]]
    wrong += [(TypeError, value) for value in (right.tolist(), right.numpy(), None)]
    wrong += [(TypeError, right.to(dtype)) for dtype in WRONG_DTYPES]
    if name != "means":  # those of the others are those of the means
        wrong += [(TypeError, right.to(other)) for other in (torch.float64, "meta")]
    for error, value in wrong:
        with pytest.raises(error, match=f"^{name}:"):
            Gaussians(**given | {name: value})


@pytest.mark.parametrize("rows", [None, 2])
def test_gaussians_are_selected_by_mask_indices_and_slice(rows):
    given = {name: torch.rand_like(value) for name, value in fields().items()}
    if rows:
        given["opacities"] = torch.rand(rows, 5)
    gaussians = Gaussians(**given)
    mask = torch.tensor([True, False, True, False, True])
    for index in (mask, torch.tensor([0, 2, 4]), slice(None, None, 2)):
        part = gaussians[index]
        assert len(part) == 3
        for name, value in given.items():
            assert torch.equal(getattr(part, name), value[..., ::2] if name == "opacities" else value[::2])


def test_gaussians_move_to_another_dtype_and_device():
    gaussians = Gaussians(**fields())
    assert all(getattr(gaussians.to(torch.float64), name).dtype == torch.float64 for name in fields())
    assert all(getattr(gaussians.to("meta"), name).device.type == "meta" for name in fields())


def test_options_may_be_numbers_of_numpy():
    """They become Python's: compiled kernels know no others."""
    made = kgs.RasterOptions(tile_size=np.int64(16), near_plane=np.float32(0.5), far_plane=np.float64(9), eps2d=0)
    assert (made.tile_size, made.near_plane, made.far_plane, made.eps2d) == (16, 0.5, 9.0, 0.0)
    assert [type(x) for x in (made.tile_size, made.near_plane, made.far_plane, made.eps2d)] == [int] + [float] * 3
    frame = kgs.RasterOptions(frame=tuple(np.arange(4, dtype=np.float32))).frame
    assert frame == (0.0, 1.0, 2.0, 3.0)
    assert type(frame[0]) is float


@pytest.mark.parametrize("function", [kgs.rasterization, kgs.reference.render])
def test_every_default_is_that_of_the_options(function):
    expected = vars(kgs.RasterOptions()) | {"far_plane": 1e10}  # gsplat's is as good as none
    parameters = inspect.signature(function).parameters
    shared = parameters.keys() & expected.keys()
    assert len(shared) > 3
    assert {name: parameters[name].default for name in shared} == {name: expected[name] for name in shared}


def test_print_shows_shapes_and_no_numbers():
    shapes = "means=(5, 3), quats=(5, 4), scales=(5, 3), opacities=(5,), colors=(5, 4, 3)"
    assert repr(Gaussians(**fields())) == f"Gaussians({shapes})"
