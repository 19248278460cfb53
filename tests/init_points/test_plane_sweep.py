"""The plane sweep: scores by their definition, compiled against torch's, the same bits on any number of threads."""

import pytest
import torch
from kernel_checks import check_bits
from torch.nn.functional import grid_sample, pad

from kgs.backends import BACKENDS
from kgs.datasets.synthetic import synthetic_scene
from kgs.init_points import plane_sweep
from kgs.init_points import sweep_costs as sweep_costs_module
from kgs.init_points.sweep_costs import sweep_costs

pytest.importorskip("numba")


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


def correlations(image, other, homography):
    """NCC of windows of 7x7 by its definition, `(H, W)` float64; NaN where a window leaves the other image."""
    height, width = image.shape
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    x, y, z = torch.einsum("ij,jhw->ihw", homography, torch.stack([columns, rows, torch.ones_like(rows)]).double())
    u, v = x / z, y / z
    margin = sweep_costs_module.MARGIN
    inside = (z > 0) & (u >= -margin) & (u <= width - 1 + margin) & (v >= -margin) & (v <= height - 1 + margin)
    grid = torch.stack([2 * u / (width - 1) - 1, 2 * v / (height - 1) - 1], -1).where(inside[..., None], 0)
    warped = grid_sample(other[None, None].double(), grid[None], padding_mode="border", align_corners=True)[0, 0]
    layers = torch.stack([image.double(), warped.where(inside, 0), inside.double()])
    windows = pad(layers[None], (3, 3, 3, 3), mode="replicate")[0].unfold(1, 7, 1).unfold(2, 7, 1).flatten(3)
    one, two = (windows - windows.mean(-1, keepdim=True))[:2]
    variances = [(values * values).mean(-1) + sweep_costs_module.VARIANCE for values in (one, two)]
    return ((one * two).mean(-1) / (variances[0] * variances[1]).sqrt()).where(windows[2].all(-1), torch.nan)


@pytest.mark.parametrize("backend", ["numba", "torch"])
@pytest.mark.parametrize(
    ("count", "height", "width", "planes"),
    [(1, 7, 9, 3), (4, 7, 9, 3), (1, 33, 20, 16), (4, 16, 67, 21), (2, 41, 140, 17)],  # up to four tiles of pixels
)
def test_scores_are_correlations(count, height, width, planes, backend):
    image, others, turns = pictures(count, height, width, planes)
    scores = torch.stack(
        [
            torch.stack([correlations(image, *pair) for pair in zip(others, plane, strict=True)])
            for plane in turns.transpose(0, 1)
        ],
        1,
    )
    seen = ~scores.isnan()
    best, second = scores.where(seen, -2).topk(min(count, 2), 0).values[[0, -1]]
    if count > 1:
        best = 0.75 * best + 0.25 * second.where(seen.sum(0) > 1, sweep_costs_module.ALONE * best)
    assert bool(seen.any())
    assert bool((~seen).any())
    _, unsmoothed = sweep_costs(image, others, turns, BACKENDS[backend])
    expected = 1 - best.where(seen.any(0), sweep_costs_module.UNSEEN)
    torch.testing.assert_close(unsmoothed, expected.float(), rtol=1e-6, atol=2e-6, check_stride=False)


@pytest.mark.parametrize(("height", "width", "planes"), [(7, 9, 3), (33, 20, 16), (16, 67, 21), (41, 40, 40)])
def test_smoothed_costs_are_torchs(height, width, planes):
    image, others, turns = pictures(2, height, width, planes)
    smoothed, unsmoothed = sweep_costs(image, others, turns, BACKENDS["numba"])
    expected = sweep_costs_module._semi_global(unsmoothed.contiguous(), image)
    torch.testing.assert_close(smoothed, expected, rtol=1e-6, atol=2e-6, check_stride=False)


@pytest.mark.parametrize("last_row", [[0.002, -0.003, 1.0], [-0.1, 0.0, 1.0]])
def test_a_warped_ramp_is_a_ramp_and_empty_behind_the_camera(last_row):
    """Bilinear interpolation does not change a + b x + c y, so the points can be read from the grey values."""
    homography = torch.tensor([[1.1, 0.05, -2.3], [-0.04, 0.93, 1.7], last_row], dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(20), torch.arange(30), indexing="ij")
    ramp = 0.2 + 0.01 * columns + 0.02 * rows
    x, y, z = torch.einsum("ij,jhw->ihw", homography, torch.stack([columns, rows, torch.ones_like(rows)]).double())
    u, v = x / z, y / z
    expected = (z > 0) & (u >= 0) & (u <= 29) & (v >= 0) & (v <= 19)
    assert expected.any()
    (warped,), (inside,) = sweep_costs_module.warp(ramp, homography[None])
    assert torch.equal(inside, expected)
    torch.testing.assert_close(warped, (0.2 + 0.01 * u + 0.02 * v).where(expected, 0).float(), rtol=0, atol=1e-5)


def boxes(images):
    """What `_box` does on a GPU."""
    return sweep_costs_module._pooled(images.reshape(-1, *images.shape[-2:])).reshape(images.shape)


@pytest.mark.parametrize("size", [(7, 9), (1, 20), (3, 2), (40, 61)])
def test_windows_on_a_gpu_have_the_means_of_opencv(size):
    images = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(boxes(images), sweep_costs_module._box(images), rtol=1e-12, atol=1e-14)


def test_a_sweep_stays_on_its_device_and_its_maps_are_on_the_cpu(monkeypatch):
    """The meta device stands for a GPU: an operator that gets tensors of both raises an error."""
    fetched = []

    def cpu(tensor):
        fetched.append(tensor.device.type)
        return torch.zeros_like(tensor, device="cpu")

    views = synthetic_scene(train_views=2, test_views=1, size=(24, 32), seed=0).train
    to_cpu = torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "cpu", lambda x: cpu(x) if x.is_meta else to_cpu(x))
    maps = plane_sweep.sweep_depths(views, 2.0, 20.0, backend="auto", device=torch.device("meta"))
    assert len(maps) == len(views)
    for depth_map in maps:
        for values in vars(depth_map).values():
            assert (values.device.type, values.shape) == ("cpu", views.images.shape[-2:])
    assert fetched == ["meta"] * 3 * len(views)


@pytest.mark.parametrize(("height", "width", "planes"), [(70, 61, 24), (300, 400, 2)])  # torch divides larger sums
def test_bits_depend_neither_on_threads_nor_on_repetition(height, width, planes):
    arguments = pictures(2, height, width, planes)
    check_bits(lambda: sweep_costs(*arguments, BACKENDS["numba"]), (1, 1, 2, 2, 3, 3, 4, 4))
