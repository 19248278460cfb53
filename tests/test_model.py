import math

import numpy as np
import pytest
import torch

from kgs.model import GaussianModel, _nearest


def cloud(n=200, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(n, 3, generator=generator, dtype=dtype)
    return points, torch.rand(n, 3, generator=generator, dtype=dtype)


def model(n=7, degree=3, dtype=torch.float32):
    made = GaussianModel.from_points(*cloud(n, dtype=dtype), sh_degree=degree)
    with torch.no_grad():
        made.sh_rest.normal_(generator=torch.Generator().manual_seed(1))
    return made


def test_activations_are_exp_and_sigmoid():
    made = model()
    with torch.no_grad():
        made.log_scales[0] = torch.tensor([0.0, math.log(2.0), -1.0])
        made.opacity_logits[0] = math.log(3.0)
    gaussians = made()
    assert gaussians.scales[0].tolist() == pytest.approx([1.0, 2.0, math.exp(-1.0)], rel=1e-6)
    assert gaussians.opacities[0].item() == pytest.approx(0.75, rel=1e-6)
    assert gaussians.means is made.means
    assert gaussians.quats is made.quats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_only_the_active_bands_are_in_colors(degree):
    made = model()
    made.sh_degree = degree
    colors = made().colors
    size = (degree + 1) ** 2
    assert colors.shape == (7, size, 3)
    assert torch.equal(colors, torch.cat([made.sh_dc, made.sh_rest], dim=1)[:, :size])
    colors.sum().backward()
    if degree == 0:
        assert colors is made.sh_dc
        assert made.sh_rest.grad is None
    else:
        assert torch.equal(made.sh_rest.grad[:, : size - 1], torch.ones(7, size - 1, 3))
        assert not made.sh_rest.grad[:, size - 1 :].any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_degree_has_six_parameters_and_starts_active(degree):
    made = model(degree=degree)
    assert made.sh_degree == made.max_sh_degree == degree
    assert [name for name, _ in made.named_parameters()] == [
        *("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
    ]
    assert len(made) == 7


def test_first_values_follow_the_recipe():
    points, colors = cloud()
    made = GaussianModel.from_points(points, colors)
    gaussians = made()
    assert torch.equal(made.means, points)
    assert torch.allclose(0.28209479177387814 * made.sh_dc[:, 0] + 0.5, colors, atol=1e-7)
    assert not made.sh_rest.any()
    assert torch.equal(made.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(200, 4))
    assert torch.allclose(gaussians.opacities, torch.full((200,), 0.1))


def test_scale_is_the_root_of_the_mean_of_squared_distances():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 4.0]])
    scales = GaussianModel.from_points(points, torch.zeros(4, 3))().scales
    expected = [math.sqrt((1 + 4 + 16) / 3), math.sqrt((1 + 5 + 17) / 3)]
    assert torch.allclose(scales[:2], torch.tensor(expected)[:, None], rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scales_agree_with_scipy(dtype):
    spatial = pytest.importorskip("scipy.spatial", reason="scipy is the oracle for nearest neighbours")
    points, colors = cloud(3000, dtype=dtype)
    points = points * torch.tensor([1.0, 10.0, 0.1], dtype=dtype) + 5.0
    distances, _ = spatial.cKDTree(points.double().numpy()).query(points.double().numpy(), k=4)
    expected = np.sqrt((distances[:, 1:] ** 2).mean(axis=1))
    scales = GaussianModel.from_points(points, colors)().scales
    assert scales.dtype == dtype
    assert np.allclose(scales.detach().numpy(), expected[:, None], rtol=1e-6)


def test_neighbours_from_all_distances_agree_with_scipy(monkeypatch):
    spatial = pytest.importorskip("scipy.spatial", reason="scipy is the oracle for nearest neighbours")
    monkeypatch.setattr("kgs.model.CHUNK_ELEMENTS", 10_000)  # several chunks, the last one shorter
    points, _ = cloud(501)
    _, expected = spatial.cKDTree(points.numpy()).query(points.numpy(), k=4)
    assert np.array_equal(_nearest(points).numpy(), expected[:, 1:])


@pytest.mark.parametrize("unit", [1e-15, 1e-3, 1e6, 1e15])
def test_scales_follow_the_unit_of_the_points(unit):
    points, colors = cloud()
    points[:10] = points[0]
    at_one = GaussianModel.from_points(points, colors).log_scales
    scaled = GaussianModel.from_points(points * unit, colors).log_scales
    assert torch.allclose(scaled, at_one + math.log(unit), atol=1e-4)


def test_scales_do_not_depend_on_the_place_of_the_cloud():
    points, colors = cloud(dtype=torch.float64)
    shifted = points + torch.tensor([1e6, -2e6, 3e6], dtype=torch.float64)
    here, there = (GaussianModel.from_points(x, colors).log_scales for x in (points, shifted))
    assert torch.allclose(here, there, atol=1e-6)


@pytest.mark.parametrize("copies", [4, 100, 190])
def test_coinciding_points_get_a_small_finite_scale(copies):
    points, colors = cloud()
    points[:copies] = points[0]
    scales = GaussianModel.from_points(points, colors)().scales
    assert bool(torch.isfinite(scales.log()).all())
    assert 1e-4 < scales[0, 0] / scales[copies:].median() < 1e-2


def test_the_same_points_give_the_same_bits():
    first, second = (GaussianModel.from_points(*cloud()) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))


def test_double_converts_everything():
    gaussians = model().double()()
    assert gaussians.means.dtype == gaussians.colors.dtype == gaussians.scales.dtype == torch.float64


def test_a_state_dict_rebuilds_a_model_of_any_size():
    made = model(n=9, degree=2)
    again = GaussianModel(**made.state_dict(), sh_degree=1)
    assert again.sh_degree == 1
    assert all(torch.equal(a, b) for a, b in zip(made.parameters(), again.parameters(), strict=True))
    with torch.no_grad():
        again.means.zero_()
    assert bool(made.means.any())


def test_repr_says_how_many_and_which_degree():
    made = model()
    made.sh_degree = 1
    assert repr(made) == "GaussianModel(7 Gaussians, sh_degree=1 of 3, torch.float32)"


@pytest.mark.parametrize("degree", [-1, 4, 1.0, "2"])
def test_a_degree_out_of_range_is_refused(degree):
    made = model()
    with pytest.raises(ValueError, match="sh_degree: expected an integer from 0 to 3"):
        made.sh_degree = degree
    with pytest.raises(ValueError, match="sh_degree"):
        GaussianModel.from_points(*cloud(), sh_degree=degree)


@pytest.mark.parametrize(
    ("points", "colors", "error", "message"),
    [
        (torch.rand(3, 3), torch.rand(3, 3), ValueError, "points: expected at least 4"),
        (torch.rand(5, 2), torch.rand(5, 2), ValueError, r"shape \(N, 3\)"),
        (torch.rand(5, 3), torch.rand(4, 3), ValueError, r"\(5, 3\) and \(4, 3\)"),
        (torch.ones(5, 3), torch.rand(5, 3), ValueError, "points: expected points in different places"),
        (torch.full((5, 3), math.nan), torch.rand(5, 3), ValueError, "points: expected finite"),
        (torch.rand(5, 3).half(), torch.rand(5, 3), TypeError, "points: expected float32 or float64"),
        (torch.rand(5, 3), torch.zeros(5, 3, dtype=torch.uint8), TypeError, "colors: expected floating point"),
    ],
)
def test_bad_points_are_named(points, colors, error, message):
    with pytest.raises(error, match=message):
        GaussianModel.from_points(points, colors)


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("means", torch.zeros(7, 2), ValueError),
        ("quats", torch.zeros(7, 3), ValueError),
        ("opacity_logits", torch.zeros(7, 1), ValueError),
        ("sh_rest", torch.zeros(7, 4, 3), ValueError),
        ("sh_dc", torch.zeros(7, 3), ValueError),
        ("log_scales", torch.zeros(7, 3).double(), TypeError),
        ("means", torch.zeros(7, 3).half(), TypeError),
    ],
)
def test_bad_tensors_are_named(name, value, error):
    tensors = model().state_dict()
    with pytest.raises(error, match=f"{name}: expected"):
        GaussianModel(**{**tensors, name: value})
