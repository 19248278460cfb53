"""The renderer as its user meets it: outputs, backgrounds, cameras, shapes, dtypes, errors."""

import dataclasses
import math

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from oracles import pinhole, random_camera, random_gaussians

import kgs.reference
from kgs import DropGaussian, GaussianRenderer, Gaussians, PosedCamera

OUTPUTS = ("image", "alpha", "depth", "median_depth")
FIELDS = ("means", "quats", "scales", "opacities", "colors")
DTYPES = [torch.float32, torch.float64]


def batch(cameras):
    """One camera out of many."""
    parts = ("intrinsics", "extrinsics", "height", "width")
    return PinholeCamera(*(torch.cat([getattr(camera, part) for camera in cameras]) for part in parts))


def posed(kind, params, height=24, width=32, dtype=torch.float64, extrinsics=None):
    model = CameraModel(ImageSize(height, width), kind, torch.tensor(params, dtype=dtype))
    return PosedCamera(model, torch.eye(4, dtype=dtype)[None] if extrinsics is None else extrinsics)


def with_grad(gaussians):
    inputs = [getattr(gaussians, name).detach().clone().requires_grad_() for name in FIELDS]
    return Gaussians(*inputs), inputs


def largest(a, b):
    return (a - b).abs().max().item()


# --- outputs ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_each_output_alone_is_the_joint_one_and_the_others_are_none(dtype):
    gaussians, camera, renderer = random_gaussians(80, 0, dtype, 2), random_camera(24, 33, 0, dtype), GaussianRenderer()
    joint = renderer(gaussians, camera, outputs=OUTPUTS)
    for name in OUTPUTS:
        alone = renderer(gaussians, camera, outputs=(name,))
        assert torch.equal(getattr(alone, name), getattr(joint, name)), name
        assert all(getattr(alone, other) is None for other in OUTPUTS if other != name)
        assert getattr(alone, name).shape == (1, 3 if name == "image" else 1, 24, 33)
    assert renderer(gaussians, camera).alpha is None
    assert renderer(gaussians, camera, outputs=["depth"]).projected.colors.shape[1] == 0


@pytest.mark.parametrize("dtype", DTYPES)
def test_alpha_and_depth_are_what_the_reference_weights_say(dtype):
    gaussians, camera = random_gaussians(25, 1, dtype, image_size=160), random_camera(24, 32, 1, dtype)
    renderer = GaussianRenderer(alpha_threshold=0, transmittance_stop=0)
    out = renderer(gaussians, camera, outputs=("alpha", "depth", "median_depth"))
    layers = kgs.reference.layers(gaussians, camera, 0.0, 0.0)
    bound = 1e-5 if dtype == torch.float32 else 1e-11
    assert (out.alpha[0, 0] - (1 - layers.transmittance)).abs().max() <= bound
    weighted = torch.einsum("lhw,l->hw", layers.weights, layers.depths)
    alpha = 1 - layers.transmittance  # rounded near 1, which is what divides the sum
    assert (alpha < 1e-3).any()
    covered = alpha > 1.1e-6
    assert ((out.depth[0, 0] * alpha - weighted).abs() * covered).max() <= 10 * bound
    assert not out.depth[0, 0][alpha < 0.9e-6].any()
    light = 1 - torch.cumsum(layers.weights, 0)
    first = (light < 0.5).double().argmax(0)
    expected = torch.where((light < 0.5).any(0), layers.depths[first], 0.0)
    certain = ((light - 0.5).abs() > 1e-5).all(0)
    assert ((out.median_depth[0, 0] - expected).abs() * certain).max() <= bound


def test_depth_is_zero_without_gradient_where_there_is_nothing():
    gaussians, inputs = with_grad(random_gaussians(3, 0))
    camera = random_camera(48, 48, 0)
    out = GaussianRenderer()(gaussians, camera, outputs=("alpha", "depth"))
    nothing = out.alpha < 1e-6
    assert nothing.any()
    assert not out.depth[nothing].any()
    assert all(not g.any() for g in torch.autograd.grad(out.depth[nothing].sum(), inputs[:4], retain_graph=True))
    (out.depth.sum() + out.alpha.sum()).backward()
    assert all(x.grad.isfinite().all() for x in inputs[:4])


def test_depth_of_a_single_plane_is_its_depth():
    plane = dataclasses.replace(random_gaussians(40, 2), means=random_gaussians(40, 2).means * torch.tensor([1, 1, 0]))
    plane = dataclasses.replace(plane, means=plane.means + torch.tensor([0.0, 0.0, 4.0]))
    out = GaussianRenderer()(plane, pinhole(24, 32, (32.0, 32.0)), outputs=("depth", "median_depth"))
    covered = out.depth > 0
    assert covered.any()
    assert largest(out.depth[covered], torch.tensor(4.0)) <= 1e-12
    assert set(out.median_depth.unique().tolist()) <= {0.0, 4.0}


# --- background -------------------------------------------------------------------------------------------------


def test_every_form_of_background():
    cameras = batch([random_camera(24, 33, seed) for seed in (0, 1)])
    gaussians, renderer = random_gaussians(20, 0), GaussianRenderer()
    out = renderer(gaussians, cameras, outputs=("image", "alpha"))
    light = 1 - out.alpha
    one, two = torch.rand(3, dtype=torch.float64), torch.rand(2, 3, dtype=torch.float64)
    full = torch.rand(2, 3, 24, 33, dtype=torch.float64)
    for background, behind in ((one, one[None, :, None, None]), (two, two[:, :, None, None]), (full, full)):
        assert largest(renderer(gaussians, cameras, background).image, out.image + light * behind) <= 1e-15
    black = renderer(gaussians, cameras, torch.zeros(3, dtype=torch.float64)).image
    assert torch.equal(black, out.image)


@pytest.mark.parametrize("shape", [(3,), (2, 3), (2, 3, 24, 33)])
def test_gradient_of_the_background_is_the_light_that_reaches_it(shape):
    cameras = batch([random_camera(24, 33, seed) for seed in (0, 1)])
    gaussians = random_gaussians(20, 0)
    background = torch.rand(shape, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, 3, 24, 33, dtype=torch.float64)
    out = GaussianRenderer()(gaussians, cameras, background, ("image", "alpha"))
    (out.image * weights).sum().backward()
    expected = (weights * (1 - out.alpha)).detach()
    expected = expected if len(shape) == 4 else expected.sum((2, 3) if len(shape) == 2 else (0, 2, 3))
    assert largest(background.grad, expected) <= 1e-11


# --- cameras ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_sixteen_cameras_at_once_are_sixteen_single_ones(dtype):
    singles = [random_camera(24, 30, seed, dtype) for seed in range(16)]
    gaussians, inputs = with_grad(random_gaussians(50, 0, dtype, 2))
    renderer = GaussianRenderer()
    together = renderer(gaussians, batch(singles), outputs=OUTPUTS)
    apart = [renderer(gaussians, camera, outputs=OUTPUTS) for camera in singles]
    for name in OUTPUTS:
        assert torch.equal(getattr(together, name), torch.cat([getattr(one, name) for one in apart])), name
    assert torch.equal(together.projected.camera_ids.bincount(), torch.tensor([len(one.projected) for one in apart]))
    gradients = torch.autograd.grad(together.image.square().sum(), inputs)
    expected = torch.autograd.grad(sum(one.image.square().sum() for one in apart), inputs)
    for a, b in zip(gradients, expected, strict=True):
        assert largest(a, b) <= (1e-5 if dtype == torch.float32 else 1e-13) * b.abs().max()


# 512 tiles in a row; 2^15 tiles and a few more, with the last of them lit; far more than 16 bits can number
@pytest.mark.parametrize(("size", "views"), [((16, 4096), 1), ((8, 131080), 2), ((64, 4096), 9)])
def test_many_tiles_keep_their_numbers(size, views):
    height, width = size
    columns = torch.linspace(3, width - 4, 41, dtype=torch.float64).round()
    means = torch.stack([(columns - (width - 1) / 2) / 2000, torch.zeros(41), torch.ones(41)], 1) * 2
    dots = Gaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).repeat(41, 1),
        scales=torch.full((41, 3), 1e-9, dtype=torch.float64),
        opacities=torch.full((41,), 0.5, dtype=torch.float64),
        colors=torch.rand(41, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.1,
    )
    image = GaussianRenderer()(dots, batch([pinhole(height, width, (2000.0, 2000.0))] * views)).image
    lit = image[:, :, (height - 1) // 2 : height // 2 + 1].sum(2)  # the two middle rows share each dot
    scale = 2 * 0.5 * math.exp(-0.5 * 0.25 / 0.3)
    assert (lit[:, :, columns.long()] - scale * dots.colors.T).abs().max() <= 1e-6
    dark = torch.ones(width, dtype=torch.bool)
    for shift in (-3, -2, -1, 0, 1, 2, 3):
        dark[columns.long() + shift] = False
    assert not image[..., dark].any()


def test_orthographic_camera_is_the_marginal_of_each_gaussian():
    # B2: parallel rays integrate along z, so the footprint is the upper left block of R Sigma R^T, scaled
    gaussians = dataclasses.replace(
        random_gaussians(1, 3, sh_degree=None), means=torch.tensor([[0.3, -0.2, 5.0]]).double()
    )
    fx, fy, cx, cy = 9.0, 7.0, 15.0, 11.5
    turn = random_camera(24, 32, 8).extrinsics
    camera = posed(CameraModelType.ORTHOGRAPHIC, [fx, fy, cx, cy], extrinsics=turn)
    alpha = GaussianRenderer(alpha_threshold=0)(gaussians, camera, outputs=("alpha",)).alpha[0, 0]
    w, x, y, z = (gaussians.quats[0] / gaussians.quats[0].norm()).tolist()
    local = torch.linalg.matrix_exp(  # of the rotation vector of the quaternion
        2
        * math.atan2(math.hypot(x, y, z), w)
        / math.hypot(x, y, z)
        * torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    )
    covariance = local @ torch.diag(gaussians.scales[0] ** 2) @ local.T
    rotation, translation = turn[0, :3, :3], turn[0, :3, 3]
    view = torch.diag(torch.tensor([fx, fy])).double() @ (rotation @ covariance @ rotation.T)[:2, :2]
    marginal = view @ torch.diag(torch.tensor([fx, fy])).double() + 0.3 * torch.eye(2, dtype=torch.float64)
    centre = (rotation @ gaussians.means[0] + translation)[:2] * torch.tensor([fx, fy]) + torch.tensor([cx, cy])
    d = torch.cartesian_prod(torch.arange(24), torch.arange(32)).flip(1) - centre
    expected = gaussians.opacities[0] * torch.exp(-0.5 * (d * torch.linalg.solve(marginal, d.T).T).sum(1))
    assert largest(alpha.reshape(-1), expected) <= 1e-12


def test_pinhole_of_both_kinds_is_one_image():
    gaussians, camera = random_gaussians(40, 0, sh_degree=3), random_camera(24, 32, 0)
    k = camera.intrinsics[0]
    params = [k[0, 0].item(), k[1, 1].item(), k[0, 2].item(), k[1, 2].item()]
    other = posed(CameraModelType.PINHOLE, params, extrinsics=camera.extrinsics)
    assert largest(GaussianRenderer()(gaussians, camera).image, GaussianRenderer()(gaussians, other).image) <= 1e-12


def test_brown_conrady_without_distortion_is_the_pinhole():
    gaussians, camera = random_gaussians(40, 0, sh_degree=3), random_camera(24, 32, 0)
    k = camera.intrinsics[0]
    params = [k[0, 0].item(), k[1, 1].item(), k[0, 2].item(), k[1, 2].item()]
    lens = posed(CameraModelType.BROWN_CONRADY, params + [0.0] * 8, extrinsics=camera.extrinsics)
    expected = GaussianRenderer()(gaussians, camera, outputs=("image", "depth"))
    out = GaussianRenderer()(gaussians, lens, outputs=("image", "depth"))
    assert largest(out.image, expected.image) <= 1e-10
    assert largest(out.depth, expected.depth) <= 1e-10
    bent = posed(CameraModelType.BROWN_CONRADY, [*params, 0.2, *[0.0] * 7], extrinsics=camera.extrinsics)
    assert largest(GaussianRenderer()(gaussians, bent).image, expected.image) > 1e-3


def test_fisheye_puts_a_dot_where_the_angle_says():
    # Kannala-Brandt without higher terms is the equidistant projection: radius = f times the angle off the axis
    f, angle = 20.0, 0.6
    camera = posed(CameraModelType.KANNALA_BRANDT_K3, [f, f, 16.0, 12.0, 0.0, 0.0, 0.0, 0.0], 25, 33)
    dot = Gaussians(
        means=torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]]).double() * 3,
        quats=torch.tensor([[1.0, 0, 0, 0]]).double(),
        scales=torch.full((1, 3), 1e-6).double(),
        opacities=torch.tensor([0.9]).double(),
        colors=torch.ones(1, 3).double(),
    )
    mass = GaussianRenderer(alpha_threshold=0)(dot, camera, outputs=("alpha",)).alpha[0, 0]
    x = (mass.sum(0) * torch.arange(33)).sum() / mass.sum()
    y = (mass.sum(1) * torch.arange(25)).sum() / mass.sum()
    assert x.item() == pytest.approx(16 + f * angle, abs=0.02)
    assert y.item() == pytest.approx(12, abs=1e-6)
    gaussians, inputs = with_grad(random_gaussians(30, 0, sh_degree=1))
    image = GaussianRenderer()(gaussians, camera).image
    assert image.isfinite().all()
    assert (image > 0).any()
    image.sum().backward()
    assert all(x.grad.isfinite().all() and x.grad.any() for x in inputs)


def test_one_lens_for_several_poses_and_one_lens_each():
    kind = CameraModelType.BROWN_CONRADY
    params = [30.0, 31.0, 15.5, 11.5, 0.05, -0.02, 0.001, 0.002, 0.0, 0.0, 0.0, 0.0]
    poses = torch.cat([random_camera(24, 32, seed).extrinsics for seed in (0, 1)])
    gaussians, renderer = random_gaussians(30, 1), GaussianRenderer()
    shared = renderer(gaussians, posed(kind, params, extrinsics=poses)).image
    apart = [renderer(gaussians, posed(kind, params, extrinsics=poses[i : i + 1])).image for i in (0, 1)]
    assert torch.equal(shared, torch.cat(apart))
    wide = [20.0, *params[1:]]
    each = renderer(gaussians, posed(kind, [params, wide], extrinsics=poses)).image
    assert torch.equal(each[:1], apart[0])
    assert torch.equal(each[1:], renderer(gaussians, posed(kind, wide, extrinsics=poses[1:])).image)


def test_opacities_a_camera():
    cameras = batch([random_camera(24, 32, seed) for seed in (0, 1)])
    gaussians = random_gaussians(30, 0)
    mine = torch.stack([gaussians.opacities, gaussians.opacities.flip(0)]).requires_grad_()
    out = GaussianRenderer()(dataclasses.replace(gaussians, opacities=mine), cameras).image
    for c in (0, 1):
        one = dataclasses.replace(gaussians, opacities=mine[c].detach())
        single = random_camera(24, 32, c)
        assert torch.equal(out[c : c + 1], GaussianRenderer()(one, single).image)
    out[0].sum().backward()
    assert mine.grad[0].any()
    assert not mine.grad[1].any()


# --- the opacity layer and the colours --------------------------------------------------------------------------


class Half(torch.nn.Module):
    def forward(self, opacities):
        return opacities / 2 if self.training else opacities


def test_opacity_layer_is_applied_and_reached_by_train_and_eval():
    gaussians, camera = random_gaussians(30, 0), random_camera(24, 32, 0)
    halved = dataclasses.replace(gaussians, opacities=gaussians.opacities / 2)
    plain, renderer = GaussianRenderer(), GaussianRenderer(opacity_layer=Half())
    assert torch.equal(renderer(gaussians, camera).image, plain(halved, camera).image)
    pipeline = torch.nn.ModuleDict({"renderer": renderer}).eval()
    assert not renderer.opacity_layer.training
    assert torch.equal(renderer(gaussians, camera).image, plain(gaussians, camera).image)
    pipeline.train()
    assert torch.equal(renderer(gaussians, camera).image, plain(halved, camera).image)


def test_dropped_gaussians_are_seen_but_not_drawn():
    gaussians, camera = random_gaussians(60, 0), pinhole(64, 64, (40.0, 40.0))
    drop = DropGaussian(p=0.5, schedule="constant", seed=3)
    renderer = GaussianRenderer(opacity_layer=drop)
    gaussians, inputs = with_grad(gaussians)
    out = renderer(gaussians, camera)
    full = renderer.eval()(gaussians, camera)
    dropped = out.projected.opacities == 0
    assert 10 < dropped.sum() < 50
    assert torch.equal(out.projected.gaussian_ids, full.projected.gaussian_ids)
    assert torch.equal(out.projected.radii, full.projected.radii)
    out.image.square().sum().backward()
    ids = out.projected.gaussian_ids[dropped]
    assert all(not x.grad[ids].any() for x in inputs)
    assert not out.projected.means2d.grad[dropped].any()
    assert out.projected.means2d.grad[~dropped].any()
    kept = [x.detach()[~torch.isin(torch.arange(60), ids)] for x in inputs]
    kept[3] = kept[3] * 2
    assert torch.equal(out.image, GaussianRenderer()(Gaussians(*kept), camera).image)


def test_rgb_is_taken_as_it_is_and_harmonics_are_shifted_by_a_half():
    gaussians, camera = random_gaussians(30, 0, sh_degree=None), random_camera(24, 32, 0)
    constant = (gaussians.colors - 0.5)[:, None] * (2 * math.sqrt(math.pi))
    for size in (1, 4, 9, 16):
        colors = torch.cat([constant, constant.new_zeros(30, size - 1, 3)], 1)
        other = dataclasses.replace(gaussians, colors=colors)
        assert largest(GaussianRenderer()(gaussians, camera).image, GaussianRenderer()(other, camera).image) <= 1e-14
    bright = dataclasses.replace(gaussians, colors=gaussians.colors * 100 - 50)
    assert GaussianRenderer()(bright, camera).image.min() < -1  # neither colours nor the image are clamped


# --- degenerate sizes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 3])
@pytest.mark.parametrize("views", [1, 3])
def test_nothing_to_see(n, views):
    gaussians = random_gaussians(n, 0, torch.float32, 1)
    gaussians = dataclasses.replace(gaussians, means=gaussians.means * torch.tensor([1.0, 1.0, -1.0]))
    gaussians, inputs = with_grad(gaussians)
    background = torch.rand(3, requires_grad=True)
    cameras = batch([pinhole(9, 13, (20.0, 20.0), dtype=torch.float32)] * views)
    out = GaussianRenderer()(gaussians, cameras, background, OUTPUTS)
    assert torch.equal(out.image, background[None, :, None, None].expand(views, 3, 9, 13))
    for name in OUTPUTS[1:]:
        assert torch.equal(getattr(out, name), torch.zeros(views, 1, 9, 13))
    assert len(out.projected) == 0
    (out.image.sum() + out.alpha.sum() + out.depth.sum()).backward()
    for x in inputs:
        assert torch.equal(x.grad, torch.zeros_like(x))
    assert torch.equal(background.grad, torch.full((3,), views * 9.0 * 13.0))


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (15, 17), (16, 16), (17, 33)])
def test_images_of_any_size(size):
    gaussians, camera = random_gaussians(20, 1, image_size=12), random_camera(*size, 1)
    image = GaussianRenderer()(gaussians, camera).image
    assert image.shape == (1, 3, *size)
    assert largest(image, kgs.reference.render(gaussians, camera)) <= 1e-12


@pytest.mark.parametrize("size", [(8, 8), (16, 24), (15, 17)])
def test_the_image_is_the_users_own_to_edit(size):
    gaussians, inputs = with_grad(random_gaussians(20, 1))
    camera = random_camera(*size, 1)
    expected = torch.autograd.grad(GaussianRenderer()(gaussians, camera).image.clamp(0, 0.5).sum(), inputs)
    image = GaussianRenderer()(gaussians, camera).image
    image.clamp_(0, 0.5)
    for a, b in zip(torch.autograd.grad(image.sum(), inputs), expected, strict=True):
        assert torch.equal(a, b)


def strided(x):
    """The same values with every second element of the memory."""
    return torch.stack([x, x + 1], -1)[..., 0]


def transposed(x):
    return x.transpose(0, -1).contiguous().transpose(0, -1)


@pytest.mark.parametrize("layout", [strided, transposed])
def test_layout_in_memory_does_not_matter(layout):
    gaussians, camera = random_gaussians(40, 0, torch.float32, 3), random_camera(24, 32, 0, torch.float32)
    background = torch.rand(1, 3, 24, 32)
    results = []
    for change in (torch.Tensor.contiguous, layout):
        inputs = [change(getattr(gaussians, name)).requires_grad_() for name in FIELDS]
        image = GaussianRenderer()(Gaussians(*inputs), camera, change(background)).image
        results.append([image.detach(), *torch.autograd.grad(image.square().sum(), inputs)])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    camera = PinholeCamera(layout(camera.intrinsics), layout(camera.extrinsics), camera.height, camera.width)
    assert largest(GaussianRenderer()(gaussians, camera, background).image, results[0][0]) <= 1e-6


def test_expanded_inputs():
    gaussians, camera = random_gaussians(40, 0, torch.float32, None), random_camera(24, 32, 0, torch.float32)
    one = {name: getattr(gaussians, name)[:1].expand_as(getattr(gaussians, name)) for name in FIELDS[1:]}
    stride_0 = Gaussians(gaussians.means, **one)
    copied = Gaussians(gaussians.means, **{name: value.contiguous() for name, value in one.items()})
    background = torch.rand(1, 1, 1, 1).expand(1, 3, 24, 32)
    images = [GaussianRenderer()(g, camera, b).image for g, b in ((stride_0, background), (copied, background.clone()))]
    assert torch.equal(*images)


# --- dtypes, modes, errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_results_have_the_dtype_of_the_gaussians(dtype):
    out = GaussianRenderer()(random_gaussians(9, 0, dtype), random_camera(9, 9, 0, dtype), outputs=OUTPUTS)
    assert all(getattr(out, name).dtype == dtype for name in OUTPUTS)


@pytest.mark.parametrize("backward_inside", [False, True])
@pytest.mark.parametrize("setting", ["autocast", "medium"])
def test_lower_precision_around_it_changes_nothing(setting, backward_inside, matmul_precision):
    """Nor the gradients of Gaussians, intrinsics and pose; "medium" rounds where the processor has units for it."""
    camera = random_camera(24, 32, 0, torch.float32)
    gaussians, inputs = with_grad(random_gaussians(3000, 0, torch.float32, 3))
    inputs += [camera.intrinsics.requires_grad_(), camera.extrinsics.requires_grad_()]

    def lowered(on):
        matmul_precision("medium" if on and setting == "medium" else "highest")
        return torch.autocast("cpu", torch.bfloat16, enabled=on and setting == "autocast")

    results = []
    for on in (False, True):
        with lowered(on):
            image = GaussianRenderer()(gaussians, camera).image
            loss = image.square().sum()
        with lowered(on and backward_inside):
            results.append([image, *torch.autograd.grad(loss, inputs)])
    for name, b, a in zip(("image", *FIELDS, "intrinsics", "extrinsics"), *results, strict=True):
        assert largest(a, b) <= 1e-6 * b.abs().max(), name


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_inference_keeps_no_graph(mode, threads):
    # enough tiles for several pieces of work, so that a second thread has some
    camera = random_camera(200, 400, 0, torch.float32)
    gaussians, _ = with_grad(random_gaussians(400, 0, torch.float32, 1, image_size=100))
    expected = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        with mode():
            out = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
    finally:
        torch.set_num_threads(before)
    for name in OUTPUTS:
        assert torch.equal(getattr(out, name), getattr(expected, name))
        assert not getattr(out, name).requires_grad
    assert not out.projected.means2d.requires_grad


def test_gradient_of_means2d_is_kept():
    gaussians, inputs = with_grad(random_gaussians(40, 0))
    out = GaussianRenderer()(gaussians, random_camera(24, 32, 0))
    out.image.square().sum().backward()
    assert out.projected.means2d.grad.shape == (len(out.projected), 2)
    assert out.projected.means2d.grad.any()
    assert inputs[0].grad.any()


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int64])
def test_other_dtypes_are_a_type_error_that_names_the_argument(name, dtype):
    gaussians = random_gaussians(3, 0, torch.float32)
    with pytest.raises(TypeError, match=rf"{name}.*float32 or float64.*{dtype}"):
        dataclasses.replace(gaussians, **{name: getattr(gaussians, name).to(dtype)})


@pytest.mark.parametrize(
    ("argument", "error", "change"),
    [
        ("outputs", ValueError, {"outputs": ("imag",)}),
        ("outputs", ValueError, {"outputs": ()}),
        ("outputs", ValueError, {"outputs": "image"}),
        ("background", ValueError, {"background": torch.zeros(4)}),
        ("background", ValueError, {"background": torch.zeros(2, 3)}),
        ("background", ValueError, {"background": torch.zeros(1, 3, 12, 9)}),
        ("background", TypeError, {"background": torch.zeros(3).double()}),
        ("background", TypeError, {"background": (0, 0, 0)}),
        ("cameras", TypeError, {"cameras": None}),
        ("cameras", TypeError, {"cameras": random_camera(9, 12, 0, torch.float64)}),
        ("cameras", TypeError, {"cameras": random_camera(9, 12, 0, torch.float16)}),
        (
            "cameras",
            TypeError,
            {"cameras": posed(CameraModelType.PINHOLE, [9.0, 9.0, 6.0, 4.0], extrinsics=torch.eye(4)[None])},
        ),
        ("cameras", ValueError, {"cameras": batch([random_camera(9, w, 0, torch.float32) for w in (12, 13)])}),
        ("gaussians", TypeError, {"gaussians": None}),
    ],
)
def test_errors_name_the_argument(argument, error, change):
    arguments = {"gaussians": random_gaussians(3, 0, torch.float32), "cameras": random_camera(9, 12, 0, torch.float32)}
    with pytest.raises(error, match=rf"^{argument}: expected"):
        GaussianRenderer()(**{**arguments, **change})


def test_opacities_for_another_number_of_cameras_are_an_error():
    gaussians = dataclasses.replace(random_gaussians(3, 0), opacities=torch.full((2, 3), 0.5).double())
    with pytest.raises(ValueError, match="opacities: expected"):
        GaussianRenderer()(gaussians, random_camera(9, 12, 0))


def test_repr_says_the_options():
    text = repr(GaussianRenderer(DropGaussian(), tile_size=16))
    assert "tile_size=16" in text
    assert "alpha_threshold=0.00392157" in text
    assert "DropGaussian" in text


@pytest.mark.parametrize(
    "option",
    [
        {"near_plane": float("nan")},
        {"near_plane": -1.0},
        {"eps2d": -1.0},
        {"eps2d": float("inf")},
        {"tile_size": 0},
        {"tile_size": 8.5},
        {"alpha_threshold": 1.0},
        {"transmittance_stop": -1e-9},
    ],
)
def test_options_out_of_range_are_refused_when_the_renderer_is_made(option):
    with pytest.raises(ValueError, match=next(iter(option))):
        GaussianRenderer(**option)
