"""Projection by Triton's kernels: the same list as torch, its values and gradients in float64."""

import pytest
import torch
from factories import leaves, posed, random_camera, replace, with_camera
from kornia.sensors.camera import CameraModelType
from projection_checks import assert_alike, assert_camera_gradients, wide_scene

import kgs
from kgs import project
from kgs.backends.gpu import projection


@pytest.fixture
def handed_over(monkeypatch):
    """How often the kernels ask torch."""
    calls, real = [], projection.project_in_torch
    monkeypatch.setattr(projection, "project_in_torch", lambda *a: calls.append(1) or real(*a))
    return calls


@pytest.mark.parametrize(("degree", "cameras"), [(None, 1), (0, 1), (1, 2), (2, 1), (3, 2)])
def test_harmonics_of_every_degree_and_features(degree, cameras, handed_over):
    got, _ = assert_alike(*wide_scene(degree, 120, cameras), "triton")
    assert 30 < len(got) < 90 * cameras
    assert not handed_over


@pytest.mark.slow
def test_features_of_any_width_no_colors_and_opacities_of_each_camera():
    gaussians, cameras = wide_scene(None, 100, cameras=2)
    for width in (0, 1, 17):
        assert_alike(replace(gaussians, colors=torch.rand(100, width)), cameras, "triton")
    got, gradients = assert_alike(*wide_scene(3, 60), "triton", colors=False)
    assert got.colors.shape == (len(got), 0)
    assert gradients["colors"] is None
    assert_alike(replace(gaussians, opacities=torch.rand(2, 100)), cameras, "triton")


@pytest.mark.slow
@pytest.mark.parametrize("largest", [1.9, 50.0])
@pytest.mark.parametrize("threshold", [1 / 255, 0.0])
def test_large_opacities_widen_what_is_seen_unless_they_belong_to_one_that_is_not_finite(largest, threshold):
    gaussians, cameras = wide_scene(1, 100)
    opacities, means = gaussians.opacities.clone(), gaussians.means.clone()
    opacities[3] = largest
    assert_alike(replace(gaussians, opacities=opacities), cameras, "triton", alpha_threshold=threshold)
    means[3, 0] = torch.inf
    broken = replace(gaussians, opacities=opacities, means=means)
    found, expected = (project(broken, cameras, backend=backend) for backend in ("triton", "torch"))
    assert torch.equal(found.gaussian_ids, expected.gaussian_ids)


@pytest.mark.slow
@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "colors"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, 1e30])
def test_what_is_not_finite_or_overflows_is_left_out(field, value):
    gaussians, cameras = wide_scene(1, 60)
    changed = getattr(gaussians, field).clone()
    changed.view(-1)[7] = value
    broken = replace(gaussians, **{field: changed})
    got, listed = (project(broken, cameras, backend=backend) for backend in ("triton", "torch"))
    assert torch.equal(got.gaussian_ids, listed.gaussian_ids)
    assert torch.equal(got.num_nonfinite, listed.num_nonfinite)
    assert torch.allclose(got.factors, listed.factors, rtol=1e-5, atol=1e-5)


def test_zero_quaternions_and_flat_gaussians():
    gaussians, cameras = wide_scene(n=120)
    quats, scales = gaussians.quats.clone(), gaussians.scales.clone()
    quats[::3] = 0.0
    quats[1::3] *= 1e-30
    scales[::2, 1] = 0.0
    got, gradients = assert_alike(replace(gaussians, scales=scales), cameras, "triton")
    slopes = []
    for backend in ("triton", "torch"):
        leaf = quats.clone().requires_grad_()
        factors = project(replace(gaussians, quats=leaf), cameras, backend=backend).factors
        (factors * torch.linspace(-1, 1, factors.numel()).view_as(factors)).sum().backward()
        slopes.append((factors, leaf.grad))
    assert torch.allclose(slopes[0][0], slopes[1][0], rtol=1e-5, atol=1e-5)
    assert not slopes[0][1][::3].any()
    for rows in (slice(1, None, 3), slice(2, None, 3)):  # tiny quaternions have huge gradients
        found, expected = slopes[0][1][rows], slopes[1][1][rows]
        assert (found - expected).abs().max() <= 1e-5 * expected.abs().max()
    assert gradients["scales"].isfinite().all()
    assert len(got) > 30


@pytest.mark.parametrize("options", [{"near_plane": 4.0}, {"eps2d": 0.0}, {"frame": (10.0, 8.0, 40.0, 30.0)}])
def test_options(options):
    assert_alike(*wide_scene(1, 100), "triton", **options)


@pytest.mark.slow
@pytest.mark.parametrize("block", [[[50.0, 4.0], [0.0, 60.0]], [[-50.0, 0.0], [0.0, 60.0]]])
def test_cameras_with_skew_and_negative_focal_lengths(block, handed_over):
    gaussians, cameras = wide_scene(n=100)
    k = cameras.intrinsics[0].clone()
    k[:2, :2] = torch.tensor(block)
    assert_alike(gaussians, with_camera(cameras, intrinsics=k), "triton")
    assert not handed_over


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [torch.eye(3) * 1.7, torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.9, -0.1], [0.1, 0.0, 1.2]])],
    ids=["scaled", "sheared"],
)
def test_poses_that_are_scaled_or_sheared(change, handed_over):
    gaussians, cameras = wide_scene(3, 30)
    pose = cameras.extrinsics[0].clone()
    pose[:3, :3] = change @ pose[:3, :3]
    assert_alike(gaussians, with_camera(cameras, extrinsics=pose), "triton")
    assert_camera_gradients(gaussians, with_camera(cameras, extrinsics=pose), "triton", ("pose", "lens"))
    assert not handed_over


@pytest.mark.parametrize(
    ("degree", "wanted"),
    [
        (None, ("pose",)),
        (3, ("pose", "lens", "Gaussians")),
        pytest.param(None, ("pose", "lens", "Gaussians"), marks=pytest.mark.slow),
        pytest.param(3, ("pose",), marks=pytest.mark.slow),
    ],
)
def test_gradients_of_cameras(degree, wanted, handed_over):
    gaussians, cameras = wide_scene(degree, 30, cameras=2)
    assert_camera_gradients(gaussians, cameras, "triton", wanted)
    assert not handed_over


def test_what_the_kernels_cannot_draw_goes_to_torch(handed_over):
    gaussians, cameras = wide_scene()
    flat = cameras.extrinsics[0].clone()
    flat[2, :3] = 0.0
    lens = posed(CameraModelType.PINHOLE, torch.tensor([50.0, 55.0, 30.0, 25.0]), extrinsics=cameras.extrinsics)
    got, expected = (project(gaussians, lens, backend=backend) for backend in ("triton", "torch"))
    assert torch.equal(got.means2d, expected.means2d)
    with pytest.raises(ValueError, match="^extrinsics:"):
        project(gaussians, with_camera(cameras, extrinsics=flat), backend="triton")
    assert len(handed_over) == 2
    assert len(project(gaussians[:0], cameras, backend="triton")) == 0
    assert len(handed_over) == 3


def test_without_gradients_and_once_differentiable():
    gaussians, cameras = wide_scene(n=60)
    with torch.inference_mode():
        assert not project(gaussians, cameras, backend="triton").means2d.requires_grad
    moved, inputs = leaves(gaussians)
    loss = project(moved, cameras, backend="triton").factors.square().sum()
    first = torch.autograd.grad(loss, inputs[:3], retain_graph=True)
    with pytest.raises(RuntimeError, match="expected backward without create_graph"):
        torch.autograd.grad(loss, inputs[:3], create_graph=True)
    assert all(torch.equal(a, b) for a, b in zip(first, torch.autograd.grad(loss, inputs[:3]), strict=True))
    with pytest.raises(ValueError, match="does not cover this call of projection"):
        project(gaussians.to(torch.float64), random_camera(8, 8, 0), backend="triton")
    assert kgs.GaussianRenderer(backend="triton").backend == "triton"
