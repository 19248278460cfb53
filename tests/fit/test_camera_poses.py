"""Cameras from matrices, poses of any kind, and gradients of poses and lenses, also where nothing is in view."""

import math

import pytest
import torch
from factories import FIELDS, leaves, pinhole, posed, random_camera, random_gaussians, replace, with_camera
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.vector import Vector3
from kornia.sensors.camera import CameraModelType

import kgs
import kgs.reference
from kgs import GaussianRenderer, Gaussians

SIZE = (24, 32)
K = [[30.0, 0.0, 16.0], [0.0, 28.0, 12.0], [0.0, 0.0, 1.0]]


def dot(points, dtype=torch.float64):
    """Small white Gaussians at points of the camera frame."""
    n = len(points)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4)
    scales = 0.02 * torch.as_tensor(points).norm(dim=1, keepdim=True).expand(n, 3)
    values = (torch.as_tensor(points), quats, scales, torch.full((n,), 0.9), torch.ones(n, 3))
    return Gaussians(*(value.to(dtype) for value in values))


# --- kgs.pinhole_cameras ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [3, 4])
@pytest.mark.parametrize("count", [None, 1, 3])
def test_matrices_become_kornias_cameras(side, count):
    k = torch.eye(side)
    k[:3, :3] = torch.tensor(K)
    poses = torch.eye(4) if count is None else torch.eye(4).repeat(count, 1, 1)
    if count is not None:
        poses[:, 2, 3] = torch.arange(count)
    for ks in (k, k[None], k.repeat(count or 1, 1, 1)):
        made = kgs.pinhole_cameras(poses, ks, 32, 24)
        assert made.batch_size == (count or 1)
        assert torch.equal(made.camera_matrix, torch.tensor(K).expand(count or 1, 3, 3))
        assert torch.equal(made.intrinsics[:, 3], torch.tensor([[0.0, 0, 0, 1]]).expand(count or 1, 4))
        assert torch.equal(made.extrinsics, poses.reshape(-1, 4, 4))
        assert (made.height.tolist(), made.width.tolist()) == ([24] * (count or 1), [32] * (count or 1))
    half = kgs.pinhole_cameras(poses, k, 32, 24, pixel_centers="half")
    assert (half.cx[0], half.cy[0], half.fx[0]) == (15.5, 11.5, 30.0)


# --- nothing in view --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 5])
@pytest.mark.parametrize("cameras_too", [False, True])
@pytest.mark.parametrize("leaf", ["extrinsics", "intrinsics", "both"])
def test_a_camera_that_sees_nothing_has_gradient_zero(n, cameras_too, leaf):
    """Alone and in a batch whose other camera sees everything; all inputs or the camera's alone are leaves."""
    gaussians = random_gaussians(n, 0, sh_degree=1)
    ahead = random_camera(*SIZE, 0)
    behind = ahead.extrinsics.clone()
    behind[:, 2, 3] -= 100
    poses = torch.cat([behind, ahead.extrinsics]) if cameras_too else behind
    k = ahead.intrinsics.repeat(len(poses), 1, 1)
    poses.requires_grad_(leaf != "intrinsics")
    k.requires_grad_(leaf != "extrinsics")
    sizes = (torch.full((len(poses),), value) for value in SIZE)
    out = GaussianRenderer()(gaussians, PinholeCamera(k, poses, *sizes), outputs=("image", "alpha", "depth"))
    (out.image.square().sum() + out.alpha.sum() + out.depth.sum()).backward()
    for value in (poses, k):
        if value.requires_grad:
            assert not value.grad[0].any()
            assert not cameras_too or n == 0 or value.grad[1].any()


# --- poses and lenses as parameters -----------------------------------------------------------------------------


def test_pose_and_lens_that_are_parameters_are_optimised_with_one_camera_object():
    """Also where the sixteen numbers of the pose are free, and so no rotation any more."""
    gaussians, renderer = random_gaussians(30, 0, torch.float32, 1), GaussianRenderer()
    params, pose = torch.tensor([30.0, 28.0, 15.5, 11.5]), torch.eye(4)[None]

    target = renderer(gaussians, posed(CameraModelType.PINHOLE, params, SIZE, extrinsics=pose)).image
    params, pose = torch.nn.Parameter(params + 0.3), torch.nn.Parameter(pose.clone())
    pose.data[0, :3] += 0.02 * torch.randn(3, 4)
    one = posed(CameraModelType.PINHOLE, params, SIZE, extrinsics=pose)
    optimizer = torch.optim.Adam([params, pose], lr=0.006)
    losses = []
    for _ in range(30):
        optimizer.zero_grad()
        loss = (renderer(gaussians, one).image - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]


# --- unusual matrices -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "column", "value"), [(2, 2, 2.0), (2, 0, 0.1), (2, 2, math.nan), (3, 3, 0.5), (0, 3, 5.0)]
)
def test_intrinsics_that_are_not_a_pinhole_cameras_are_refused(row, column, value):
    gaussians, camera = random_gaussians(5, 0), random_camera(*SIZE, 0)
    GaussianRenderer()(gaussians, camera)
    k = camera.intrinsics
    k[0, row, column] = value  # in place, after the camera was used
    calls = [
        ("cameras", lambda: GaussianRenderer()(gaussians, camera)),
        ("cameras", lambda: kgs.project(gaussians, camera)),
        ("camera", lambda: kgs.reference.render(gaussians, camera)),
        ("Ks", lambda: kgs.pinhole_cameras(camera.extrinsics, k, SIZE[1], SIZE[0])),
    ]
    if row < 3 > column:
        values = [getattr(gaussians, name) for name in FIELDS]
        size = (SIZE[1], SIZE[0])
        calls.append(("Ks", lambda: kgs.rasterization(*values, camera.extrinsics, k[:, :3, :3], *size, sh_degree=0)))
    for name, call in calls:
        with pytest.raises(ValueError, match=rf"^{name}: expected .* \(0, 0, 1\)"):
            call()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_optimiser_of_whole_intrinsics_leaves_their_last_rows(dtype):
    gaussians, camera = random_gaussians(20, 0, dtype), random_camera(*SIZE, 0, dtype)
    for k, drawn in (
        (camera.intrinsics.clone(), lambda k: with_camera(camera, intrinsics=k)),
        (camera.intrinsics[0, :3, :3].clone(), lambda k: kgs.pinhole_cameras(camera.extrinsics, k, SIZE[1], SIZE[0])),
    ):
        before = k.clone()
        adam = torch.optim.Adam([k.requires_grad_()], lr=0.1)
        for _ in range(2):
            adam.zero_grad()
            GaussianRenderer()(gaussians, drawn(k)).image.square().sum().backward()
            adam.step()
        assert torch.equal(k[..., 2:, :], before[..., 2:, :])
        assert not torch.equal(k[..., :2, :], before[..., :2, :])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("kind", ["pinhole", "model"])
def test_a_negative_focal_length_mirrors_the_image(axis, kind):
    gaussians = random_gaussians(80, 0, sh_degree=None)
    gaussians = replace(gaussians, means=gaussians.means * torch.tensor([2.0, 2.0, 1.0]))
    focal = [30.0, 28.0]

    def render(fx, fy):
        if kind == "pinhole":
            return GaussianRenderer()(gaussians, pinhole(*SIZE, (fx, fy))).image
        return GaussianRenderer()(gaussians, posed(CameraModelType.PINHOLE, [fx, fy, 15.5, 11.5], SIZE)).image

    expected = render(*focal).flip(3 - axis)
    focal[axis] *= -1
    assert (render(*focal) - expected).abs().max() < 1e-12


# --- the fold of a distorted lens -------------------------------------------------------------------------------

FOLDING = [
    (CameraModelType.BROWN_CONRADY, [-0.1, 0, 0, 0, 0, 0, 0, 0]),
    (CameraModelType.BROWN_CONRADY, [-0.05, 0, 0.001, -0.001, 0, 0, 0, 0]),
    (CameraModelType.BROWN_CONRADY, [-0.3, 0.1, 0, 0, -0.02, 0, 0, 0]),
    (CameraModelType.BROWN_CONRADY, [0.2, -0.1, 0, 0, 0.01, 0.3, 0, 0]),
    (CameraModelType.BROWN_CONRADY, [0.1, 0, 0, 0, 0, -0.2, 0, 0]),  # a pole
    (CameraModelType.KANNALA_BRANDT_K3, [-0.2, 0, 0, 0]),
    (CameraModelType.KANNALA_BRANDT_K3, [0.1, -0.15, 0, 0]),
    (CameraModelType.KANNALA_BRANDT_K3, [-0.6, 0.0, 0.1, 0.0]),  # grows again behind the fold
]
STEADY = [
    (CameraModelType.BROWN_CONRADY, [0.1, 0.05, 0.001, 0.002, 0.01, 0.02, 0.03, 0.0]),
    (CameraModelType.KANNALA_BRANDT_K3, [0.05, 0.02, 0.0, 0.0]),
]


def distorted(kind, coefficients, focal=8.0, dtype=torch.float64):
    return posed(kind, [focal, focal, 16.0, 12.0, *coefficients], (25, 33), dtype)


def fold_angle(kind, coefficients):
    """The first angle where the radius that Kornia projects to stops growing, by looking at many."""
    radial = list(coefficients)
    if kind is CameraModelType.BROWN_CONRADY:
        radial[2:4] = [0, 0]
    angles = torch.linspace(0, math.radians(89.9), 20000, dtype=torch.float64)
    points = torch.stack([angles.sin(), torch.zeros_like(angles), angles.cos()], 1)
    radii = distorted(kind, radial).model.project(Vector3(points)).data[:, 0] - 16.0
    falling = (radii.diff() <= 0).nonzero()
    return float(angles[falling[0, 0]]) if len(falling) else math.pi / 2


@pytest.mark.parametrize(("kind", "coefficients"), FOLDING + STEADY)
def test_what_lies_behind_the_fold_is_not_drawn(kind, coefficients):
    camera, fold = distorted(kind, coefficients), fold_angle(kind, coefficients)
    assert (fold < math.radians(85)) == ((kind, coefficients) in FOLDING)
    angles = torch.cat([torch.linspace(0.02, 1.53, 60), torch.tensor([fold - 0.01, min(fold + 0.01, 1.55)])])
    for turn in (0.0, 2.1, 4.0):
        x, y = angles.sin() * math.cos(turn), angles.sin() * math.sin(turn)
        gaussians = dot(torch.stack([x, y, angles.cos()], 1) * 3.0)
        gaussians, inputs = leaves(gaussians)
        out = GaussianRenderer(alpha_threshold=0)(gaussians, camera, outputs=("image",))
        expected = (angles < fold).nonzero()[:, 0]
        assert torch.equal(out.projected.gaussian_ids, expected)
        out.image.square().sum().backward()
        assert all(x.grad.isfinite().all() for x in inputs)
        assert not inputs[0].grad[angles >= fold].any()
        assert inputs[0].grad[:10].any()


def test_the_gradient_of_a_folding_lens_is_that_of_what_it_sees():
    kind, coefficients = FOLDING[0]
    angles = torch.linspace(0.05, 1.4, 12)
    gaussians = dot(torch.stack([0.8 * angles.sin(), 0.6 * angles.sin(), angles.cos()], 1) * 2.0)
    params = distorted(kind, coefficients).model.params.clone().requires_grad_()
    renderer = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)

    def image(params):
        return renderer(gaussians, posed(kind, params, (25, 33))).image.sum((0, 1))

    assert torch.autograd.gradcheck(image, params, eps=1e-6, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize(("kind", "coefficients"), STEADY)
def test_a_model_made_in_inference_mode_renders_there_and_outside(kind, coefficients):
    gaussians = random_gaussians(40, 0, torch.float32, 1)
    expected = GaussianRenderer()(gaussians, distorted(kind, coefficients, dtype=torch.float32)).image
    with torch.inference_mode():
        camera = distorted(kind, coefficients, dtype=torch.float32)
        assert torch.equal(GaussianRenderer()(gaussians, camera).image, expected)
    leaf = gaussians.means.clone().requires_grad_()
    moved = replace(gaussians, means=leaf)
    image = GaussianRenderer()(moved, camera).image
    assert torch.equal(image, expected)
    image.square().sum().backward()
    assert leaf.grad.any()


@pytest.mark.parametrize("backend", kgs.backends.available())
def test_a_pinhole_made_in_inference_mode_can_be_trained_with(backend):
    gaussians = random_gaussians(3, 0, torch.float32, 1)
    with torch.inference_mode():
        camera = random_camera(8, 8, 0, torch.float32)
    leaf = gaussians.means.clone().requires_grad_()
    moved = replace(gaussians, means=leaf)
    GaussianRenderer(backend=backend)(moved, camera).image.square().sum().backward()
    assert leaf.grad.any()
