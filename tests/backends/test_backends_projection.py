"""The projection of each backend against that of torch: the same list, values and gradients within float32."""

import importlib

import pytest
import torch
from factories import FIELDS, leaves, pinhole, random_gaussians, replace, with_camera
from projection_checks import DIFFERENTIABLE, assert_alike, assert_camera_gradients, list_and_gradients, wide_scene

import kgs
from kgs import GaussianRenderer, RasterOptions, project
from kgs.backends import BACKENDS


@pytest.fixture
def handed_over(kernel_backend, monkeypatch):
    """How often the projection of the backend asks that of torch."""
    calls = []
    package = next(type(backend).__module__ for backend in BACKENDS if backend.name == kernel_backend)
    module = importlib.import_module(f"{package}.projection")
    real = module.project_in_torch
    monkeypatch.setattr(module, "project_in_torch", lambda *a: calls.append(1) or real(*a))
    return calls


@pytest.mark.parametrize("degree", [None, 0, 1, 2, 3])
@pytest.mark.parametrize("cameras", [1, 3])
def test_harmonics_of_every_degree_and_features(kernel_backend, degree, cameras, handed_over):
    got, _ = assert_alike(*wide_scene(degree, cameras=cameras), kernel_backend)
    assert 100 < len(got) < 300 * cameras
    assert not handed_over


@pytest.mark.parametrize("width", [0, 1, 7])
def test_features_of_any_width_and_no_colors_at_all(kernel_backend, width):
    gaussians, cameras = wide_scene(None, cameras=2)
    assert_alike(replace(gaussians, colors=torch.rand(400, width)), cameras, kernel_backend)
    for degree in (None, 3):
        got, grads = assert_alike(*wide_scene(degree), kernel_backend, colors=False)
        assert got.colors.shape == (len(got), 0)
        assert grads["colors"] is None


def test_opacities_of_each_camera(kernel_backend):
    gaussians, cameras = wide_scene(cameras=3)
    assert_alike(replace(gaussians, opacities=torch.rand(3, 400)), cameras, kernel_backend)


@pytest.mark.parametrize("largest", [0.0, 1.9, 2.1, 50.0])
@pytest.mark.parametrize("threshold", [1 / 255, 0.3, 0.0])
def test_large_opacities_widen_what_is_seen_unless_they_belong_to_one_that_is_not_finite(
    kernel_backend, largest, threshold
):
    gaussians, cameras = wide_scene()
    opacities = gaussians.opacities.clone()
    opacities[3] = largest
    assert_alike(replace(gaussians, opacities=opacities), cameras, kernel_backend, alpha_threshold=threshold)
    means = gaussians.means.clone()
    means[3, 0] = torch.inf
    broken, options = replace(gaussians, opacities=opacities, means=means), RasterOptions(alpha_threshold=threshold)
    found, expected = (project(broken, cameras, options=options, backend=name) for name in (kernel_backend, "torch"))
    assert torch.equal(found.gaussian_ids, expected.gaussian_ids)


def test_cameras_with_skew_negative_focal_lengths_and_an_anisotropic_block(kernel_backend):
    gaussians, cameras = wide_scene()
    for block in ([[50.0, 4.0], [0.0, 60.0]], [[-50.0, 0.0], [0.0, 60.0]], [[50.0, 4.0], [-3.0, -60.0]]):
        k = cameras.intrinsics[0].clone()
        k[:2, :2] = torch.tensor(block)
        assert_alike(gaussians, with_camera(cameras, intrinsics=k), kernel_backend)


def test_poses_that_are_scaled_or_sheared(kernel_backend):
    gaussians, cameras = wide_scene(3)
    for change in (torch.eye(3) * 1.7, torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.9, -0.1], [0.1, 0.0, 1.2]])):
        pose = cameras.extrinsics[0].clone()
        pose[:3, :3] = change @ pose[:3, :3]
        assert_alike(gaussians, with_camera(cameras, extrinsics=pose), kernel_backend)
        assert_camera_gradients(gaussians, with_camera(cameras, extrinsics=pose), kernel_backend, ("pose", "lens"))


@pytest.mark.parametrize("degree", [None, 0, 1, 3])
@pytest.mark.parametrize("wanted", [("pose",), ("lens",), ("pose", "lens"), ("pose", "lens", "Gaussians")])
def test_gradients_of_cameras(kernel_backend, degree, wanted, handed_over):
    gaussians, cameras = wide_scene(degree, cameras=2)
    lens = cameras.intrinsics + torch.tensor([[0.0, 3.0], [-2.0, 0.0]]).repeat(2, 2) * torch.eye(4)[:, [1, 0, 2, 3]]
    assert_camera_gradients(gaussians, with_camera(cameras, intrinsics=lens), kernel_backend, wanted)
    assert not handed_over


@pytest.mark.parametrize("options", [{"near_plane": 4.0}, {"eps2d": 0.0}, {"eps2d": 2.5, "near_plane": 1e-6}])
def test_options(kernel_backend, options):
    assert_alike(*wide_scene(), kernel_backend, **options)


def test_the_limits_of_the_tangents_belong_to_what_has_a_gradient(kernel_backend):
    # x / z, y / z at, within and beyond the limits (8.5 + 2.4) / 8 and (4.5 + 1.2) / 8, both exact in binary
    camera = pinhole(8, 16, 8.0, (8.0, 4.0), dtype=torch.float32)
    limits = kgs.camera.tangent_limits(
        torch.tensor([8.0, 8.0]), torch.tensor([8.0, 4.0]), kgs.camera.whole_frame((8, 16))
    )
    x = torch.stack([limits[0, 0], limits[0, 1], limits[0, 1] * 1.5, limits[0, 0] * 0.5])
    y = torch.stack([limits[1, 1], limits[1, 0] * 2, limits[1, 0], limits[1, 1] * 0.5])
    base = random_gaussians(4, 0, torch.float32, 1)
    gaussians = replace(base, means=torch.stack([x, y, torch.ones(4)], 1), scales=torch.full((4, 3), 0.5))
    values = [
        list_and_gradients(gaussians, camera, backend, alpha_threshold=0.0) for backend in (kernel_backend, "torch")
    ]
    assert values[0][0].gaussian_ids.tolist() == [0, 1, 2, 3]
    assert torch.allclose(values[0][1]["means"], values[1][1]["means"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("wanted", FIELDS)
def test_only_what_is_asked_for_has_a_gradient(kernel_backend, wanted):
    gaussians, cameras = wide_scene(1)
    found = []
    for backend in (kernel_backend, "torch"):
        leaf = getattr(gaussians, wanted).clone().requires_grad_()
        got = project(replace(gaussians, **{wanted: leaf}), cameras, backend=backend)
        fields = [getattr(got, name) for name in DIFFERENTIABLE]
        sum(x.square().sum() for x in fields if x.requires_grad).backward()
        found.append(([x.requires_grad for x in fields], leaf.grad))
    assert found[0][0] == found[1][0]
    assert torch.allclose(found[0][1], found[1][1], rtol=1e-4, atol=1e-5 * float(found[1][1].abs().max()))


def test_a_second_backward_needs_the_graph_and_a_second_derivative_is_refused(kernel_backend):
    gaussians, inputs = leaves(wide_scene()[0])
    loss = project(gaussians, wide_scene()[1], backend=kernel_backend).factors.square().sum()
    first = torch.autograd.grad(loss, inputs[:3], retain_graph=True)
    with pytest.raises(RuntimeError, match="expected backward without create_graph"):
        torch.autograd.grad(loss, inputs[:3], create_graph=True)
    second = torch.autograd.grad(loss, inputs[:3])
    assert all(torch.equal(x, y) for x, y in zip(first, second, strict=True))
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(loss, inputs[:3])


def test_cameras_of_another_form_go_to_torch(kernel_backend, handed_over):
    gaussians, cameras = wide_scene()
    flat = cameras.extrinsics.clone()
    flat[0, 2, :3] = 0.0
    with pytest.raises(ValueError, match="^extrinsics:"):
        project(gaussians, with_camera(cameras, extrinsics=flat), backend=kernel_backend)
    project(gaussians, cameras, options=RasterOptions(near_plane=0.0), backend=kernel_backend)
    assert len(handed_over) == 2


def test_float64_is_refused_by_name_and_left_to_torch_by_auto(kernel_backend):
    gaussians, cameras = wide_scene()
    list_and_gradients(gaussians, cameras, "auto", torch.float64)
    with pytest.raises(ValueError, match=f"backend: {kernel_backend!r} does not cover this call of projection"):
        list_and_gradients(gaussians, cameras, kernel_backend, torch.float64)


def test_the_same_bits_on_any_number_of_threads(kernel_backend, set_threads):
    gaussians, cameras = wide_scene(3, 5300, cameras=2)
    found = []
    for threads in (1, 2, 3, 4):
        set_threads(threads)
        found.append(list_and_gradients(gaussians, cameras, kernel_backend))
        pose = cameras.extrinsics.clone().requires_grad_()
        moved = type(cameras)(cameras.intrinsics, pose, cameras.height, cameras.width)
        project(gaussians, moved, backend=kernel_backend).factors.square().sum().backward()
        found[-1][1]["pose"] = pose.grad
    (first, first_grads), *others = found
    for got, grads in others:
        assert all(
            torch.equal(getattr(got, name), getattr(first, name)) for name in (*DIFFERENTIABLE, "radii", "gaussian_ids")
        )
        assert all(torch.equal(grads[name], first_grads[name]) for name in (*FIELDS, "pose"))


def test_a_camera_that_is_changed_before_the_backward_pass_does_not_change_it(kernel_backend):
    gaussians, cameras = wide_scene()
    found = []
    for shift in (0.0, 0.5):
        means = gaussians.means.clone().requires_grad_()
        image = GaussianRenderer(backend=kernel_backend)(replace(gaussians, means=means), cameras).image
        cameras.extrinsics[0, 0, 3] += shift
        image.square().sum().backward()
        found.append(means.grad)
    assert torch.equal(*found)
