"""The renderer as its user meets it: backgrounds, layers, modes, options."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch
from factories import FIELDS, OUTPUTS, batch, leaves, pinhole, random_camera, random_gaussians

from kgs import DropGaussian, GaussianRenderer, Gaussians, RasterOptions, composite, project

pytestmark = pytest.mark.usefixtures("each_backend")


def largest(a, b):
    return (a - b).abs().max().item()


def test_depth_is_zero_without_gradient_where_there_is_nothing():
    gaussians, inputs = leaves(random_gaussians(3, 0))
    camera = random_camera(48, 48, 0)
    out = GaussianRenderer()(gaussians, camera, outputs=("alpha", "depth"))
    nothing = out.alpha < 1e-6
    assert nothing.any()
    assert not out.depth[nothing].any()
    assert all(not g.any() for g in torch.autograd.grad(out.depth[nothing].sum(), inputs[:4], retain_graph=True))
    (out.depth.sum() + out.alpha.sum()).backward()
    assert all(x.grad.isfinite().all() for x in inputs[:4])


# -- background ----------------------------------------------------------------------------------------------------


def test_every_form_of_background(exactly):
    dtype, bound = exactly
    cameras = batch(*[random_camera(24, 33, seed, dtype) for seed in (0, 1)])
    gaussians, renderer = random_gaussians(20, 0, dtype), GaussianRenderer()
    out = renderer(gaussians, cameras, outputs=("image", "alpha"))
    light = 1 - out.alpha
    one, two, full = (torch.rand(shape, dtype=dtype) for shape in ((3,), (2, 3), (2, 3, 24, 33)))
    forms = ((one, one[None, :, None, None]), (two, two[:, :, None, None]), (full, full), (full[1], full[1]))
    for background, behind in forms:
        assert largest(renderer(gaussians, cameras, background).image, out.image + light * behind) <= 0.1 * bound
    black = renderer(gaussians, cameras, torch.zeros(3, dtype=dtype)).image
    assert torch.equal(black, out.image)


@pytest.mark.parametrize("shape", [(3,), (2, 3), (2, 3, 24, 33)])
def test_gradient_of_the_background_is_the_light_that_reaches_it(shape):
    cameras = batch(*[random_camera(24, 33, seed) for seed in (0, 1)])
    gaussians = random_gaussians(20, 0)
    background = torch.rand(shape, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, 3, 24, 33, dtype=torch.float64)
    out = GaussianRenderer()(gaussians, cameras, background, ("image", "alpha"))
    (out.image * weights).sum().backward()
    expected = (weights * (1 - out.alpha)).detach()
    expected = expected if len(shape) == 4 else expected.sum((2, 3) if len(shape) == 2 else (0, 2, 3))
    assert largest(background.grad, expected) <= 1e-11


class Half(torch.nn.Module):
    def forward(self, opacities):
        return opacities / 2 if self.training else opacities


# -- the opacity layer and the colours -----------------------------------------------------------------------------


def test_opacity_layer_is_applied_and_reached_by_train_and_eval(exactly):
    gaussians, camera = random_gaussians(30, 0, exactly[0]), random_camera(24, 32, 0, exactly[0])
    halved = dataclasses.replace(gaussians, opacities=gaussians.opacities / 2)
    plain, renderer = GaussianRenderer(), GaussianRenderer(opacity_layer=Half())
    assert torch.equal(renderer(gaussians, camera).image, plain(halved, camera).image)
    pipeline = torch.nn.ModuleDict({"renderer": renderer}).eval()
    assert not renderer.opacity_layer.training
    assert torch.equal(renderer(gaussians, camera).image, plain(gaussians, camera).image)
    pipeline.train()
    assert torch.equal(renderer(gaussians, camera).image, plain(halved, camera).image)


def test_dropped_gaussians_are_seen_but_not_drawn(exactly):
    dtype, bound = exactly
    gaussians, camera = random_gaussians(60, 0, dtype), pinhole(64, 64, (40.0, 40.0), dtype=dtype)
    drop = DropGaussian(p=0.5, schedule="constant", seed=3)
    renderer = GaussianRenderer(opacity_layer=drop)
    gaussians, inputs = leaves(gaussians)
    out = renderer(gaussians, camera)
    full = renderer.eval()(gaussians, camera)
    dropped = out.projected.opacities == 0
    assert 10 < dropped.sum() < 50
    assert torch.equal(out.projected.gaussian_ids, full.projected.gaussian_ids)
    assert torch.equal(out.projected.radii, full.projected.radii)
    out.projected.means2d.retain_grad()
    out.image.square().sum().backward()
    ids = out.projected.gaussian_ids[dropped]
    assert all(not x.grad[ids].any() for x in inputs)
    assert not out.projected.means2d.grad[dropped].any()
    assert out.projected.means2d.grad[~dropped].any()
    kept = [x.detach()[~torch.isin(torch.arange(60), ids)] for x in inputs]
    kept[3] = kept[3] * 2
    assert largest(out.image, GaussianRenderer()(Gaussians(*kept), camera).image) <= bound


def test_neither_colors_nor_the_image_are_clamped():
    gaussians = random_gaussians(30, 0, sh_degree=None)
    bright = dataclasses.replace(gaussians, colors=gaussians.colors * 100 - 50)
    image = GaussianRenderer()(bright, random_camera(24, 32, 0)).image
    assert image.min() < -1
    assert image.max() > 2


# -- modes and options --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_inference_keeps_no_graph(mode, set_threads):
    # enough tiles for several pieces of work, so that a second thread has some
    camera = random_camera(80, 112, 0, torch.float32)
    gaussians, _ = leaves(random_gaussians(400, 0, torch.float32, 1, image_size=100))
    expected = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
    set_threads(2)
    with mode():
        out = GaussianRenderer()(gaussians, camera, outputs=OUTPUTS)
    for name in OUTPUTS:
        assert torch.equal(getattr(out, name), getattr(expected, name))
        assert not getattr(out, name).requires_grad
    assert not out.projected.means2d.requires_grad


def test_threads_may_differentiate_one_graph():
    gaussians, inputs = leaves(random_gaussians(200, 0, torch.float32, 1))
    out = GaussianRenderer()(gaussians, random_camera(24, 32, 0, torch.float32))
    assert not out.projected.means2d.retains_grad, "its hook is not safe in threads"
    loss = out.image.square().sum()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: torch.autograd.grad(loss, inputs, retain_graph=True), range(16)))
    assert all(torch.equal(a, b) for one in found for a, b in zip(one, found[0], strict=True))


@pytest.mark.usefixtures("torch_alone")
def test_options_are_given_whole_or_field_by_field():
    options = RasterOptions(near_plane=0.5, alpha_threshold=0.0, max_bytes=2**20)
    assert GaussianRenderer(options=options).options == options
    assert GaussianRenderer(**vars(options)).options == options
    assert GaussianRenderer().options == RasterOptions()
    gaussians, camera = random_gaussians(30, 0), random_camera(9, 12, 0)
    image = GaussianRenderer(options=options)(gaussians, camera).image
    assert torch.equal(image, GaussianRenderer(**vars(options))(gaussians, camera).image)
    projected = project(gaussians, camera, options=options)
    assert torch.equal(image, composite(projected, projected.colors, options=options).features)


@pytest.mark.usefixtures("torch_alone")
def test_repr_says_the_options():
    text = repr(GaussianRenderer(DropGaussian(), tile_size=16))
    assert "tile_size=16" in text
    assert "alpha_threshold=0.00392157" in text
    assert "DropGaussian" in text


# -- transforms ------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("torch_alone")
def test_transforms_of_functions_are_errors():
    gaussians, camera = random_gaussians(5, 0), random_camera(8, 8, 0)

    def loss(opacities, background=None):
        given = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.colors)
        return GaussianRenderer()(given, camera, background).image.square().sum()

    with pytest.raises(RuntimeError):
        torch.func.vmap(loss)(gaussians.opacities[None])
    with pytest.raises((RuntimeError, NotImplementedError)):
        torch.func.jvp(loss, (gaussians.opacities,), (torch.ones(5).double(),))
    leaf = gaussians.opacities.clone().requires_grad_()
    value = loss(leaf)
    with pytest.raises(RuntimeError):
        torch.autograd.grad(value, leaf, torch.ones(3).double(), is_grads_batched=True)
    for background in (None, torch.ones(3).double()):
        with pytest.raises(RuntimeError, match="second derivative"):
            torch.autograd.grad(loss(leaf, background), leaf, create_graph=True)


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.jacrev])
def test_reverse_transforms_are_refused_by_name(transform, field):
    gaussians, camera = random_gaussians(5, 0).to(torch.float32), random_camera(8, 8, 0, torch.float32)

    def loss(values):
        return GaussianRenderer()(replace(gaussians, **{field: values}), camera).image.sum()

    with pytest.raises(RuntimeError, match="torch.func"):
        transform(loss)(getattr(gaussians, field))
