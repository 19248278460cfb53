"""The compiled plane sweep against torch's: costs, scores and depths to the last bits, on any number of threads."""

import re

import pytest
import torch
from kernel_checks import avx_assembly, check_bits

from kgs.datasets.synthetic import synthetic_scene
from kgs.init_points import plane_sweep
from kgs.init_points.sweep_costs import sweep_costs

nb = pytest.importorskip("numba")

from kgs.init_points import sweep_kernels as kernels  # noqa: E402  # needs numba

VOLUME, IMAGE = nb.float32[:, :, ::1], nb.float32[:, ::1]
PRICES = nb.types.UniTuple(nb.float32, 4)


def pictures(count, height, width, planes, seed=0):
    """Noise, and homographies near the identity; the last of them puts a part behind the camera."""
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(1 + count, height, width, generator=generator)
    images = torch.nn.functional.avg_pool2d(images[:, None], 3, 1, 1)[:, 0]
    turns = torch.eye(3, dtype=torch.float64).repeat(count, planes, 1, 1)
    turns[..., :2, :] += 0.05 * torch.randn(count, planes, 2, 3, generator=generator, dtype=torch.float64)
    turns[..., :2, 2] += 0.1 * torch.arange(planes)[:, None]
    turns[-1, -1, 2, 0] = -1.6 / width
    return images[0], images[1:], turns


def costs(arguments, backend):
    return sweep_costs(*arguments, backend)


@pytest.mark.parametrize(("height", "width", "planes"), [(7, 9, 3), (33, 20, 16), (16, 67, 21), (41, 40, 40)])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_costs_and_scores_are_torchs(count, height, width, planes):
    arguments = pictures(count, height, width, planes)
    for results, expected in zip(costs(arguments, "numba"), costs(arguments, "torch"), strict=True):
        torch.testing.assert_close(results, expected, rtol=1e-6, atol=2e-6, check_stride=False)


@pytest.mark.parametrize("count", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_depth_maps_are_torchs(count):
    views = synthetic_scene(train_views=count, test_views=1, size=(48, 64), seed=0).train
    maps = [plane_sweep.sweep_depths(views, 2.0, 20.0, backend=backend) for backend in ("numba", "torch")]
    for results, expected in zip(*maps, strict=True):
        same = (results.depths / expected.depths - 1).abs() < 1e-4
        assert float(same.double().mean()) > 0.999
        assert float((results.scores - expected.scores)[same].abs().max()) < 1e-5


def test_bits_depend_neither_on_threads_nor_on_repetition():
    arguments = pictures(2, 70, 61, 24)
    check_bits(lambda: costs(arguments, "numba"), (1, 1, 2, 2, 3, 3, 4, 4))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "pattern", "operations"),  # of the loops over columns or planes, in the source
    [
        ("enter_scores", (*[IMAGE] * 3, nb.float32, nb.float32[:, :, :, ::1], nb.int64, VOLUME, VOLUME), "add|sub", 32),
        ("add_paths", (VOLUME, IMAGE, nb.int64, nb.int64, PRICES, VOLUME), "add|sub|min|cmp", 9),
    ],
)
def test_inner_loops_are_vector_code(name, arguments, pattern, operations):
    assembly = avx_assembly(getattr(kernels, name), nb.int64, nb.int64, *arguments)
    assert len(re.findall(rf"\bv\w*(?:{pattern})\w*p[sd]\b.*[yz]mm", assembly)) >= operations
