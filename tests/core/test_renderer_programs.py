"""The renderer inside other people's programs: compilers, other defaults, transforms of functions."""

import pytest
import torch
from factories import FIELDS, OUTPUTS, leaves, random_camera, random_gaussians

import kgs
from kgs import GaussianRenderer, Gaussians
from kgs.losses import photometric_loss

SIZE = (24, 32)


@pytest.mark.usefixtures("each_backend")
def test_results_do_not_depend_on_the_default_dtype():
    gaussians, camera = random_gaussians(60, 0, torch.float32, 3), random_camera(*SIZE, 0, torch.float32)
    results = []
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        try:
            given, inputs = leaves(gaussians)
            out = GaussianRenderer()(given, camera, torch.ones(3, dtype=torch.float32), (*OUTPUTS, "normal"))
            loss = out.image.square().sum() + out.depth.sum() + out.normal.sum()
            results.append([out.image, out.depth, out.normal, *torch.autograd.grad(loss, inputs)])
        finally:
            torch.set_default_dtype(torch.float32)
    assert all(x.dtype == torch.float32 for x in results[1])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize("kind", ["pinhole", "fisheye"])
def test_tensors_decide_the_device_whatever_the_default_is(kind):
    from factories import posed
    from kornia.sensors.camera import CameraModelType

    gaussians = random_gaussians(60, 0, torch.float32, 3)
    fisheye = kind == "fisheye"
    camera = (
        posed(CameraModelType.KANNALA_BRANDT_K3, dtype=torch.float32)
        if fisheye
        else random_camera(*SIZE, 0, torch.float32)
    )
    given, inputs = leaves(gaussians)
    expected = GaussianRenderer()(given, camera, outputs=(*OUTPUTS, "normal"))
    expected.image.square().sum().backward()
    torch.set_default_device("meta")
    try:
        other = Gaussians(*(getattr(gaussians, name).requires_grad_() for name in FIELDS))
        out = GaussianRenderer()(other, camera, outputs=(*OUTPUTS, "normal"))
        out.image.square().sum().backward()
        pose = torch.eye(4, device="cpu")
        drawn, _, _ = kgs.rasterization(
            *(getattr(gaussians, name) for name in FIELDS), pose[None], pose[None, :3, :3], 32, 24, sh_degree=3
        )
    finally:
        torch.set_default_device(None)  # "cpu" would leave a mode behind, which changes how graphs are traced
    assert drawn.device.type == "cpu"
    for name in (*OUTPUTS, "normal"):
        assert torch.equal(getattr(out, name), getattr(expected, name))
    for name, value in zip(FIELDS, inputs, strict=True):
        assert torch.equal(getattr(other, name).grad, value.grad)


@pytest.mark.slow  # tests/properties/test_pipelines.py has one in 7 s, with the layer and an optimiser
@pytest.mark.parametrize("backend", ["eager", "aot_eager", "inductor"])
def test_a_compiled_training_step_is_the_plain_one(backend):
    gaussians, camera = random_gaussians(60, 0, torch.float32, 1), random_camera(*SIZE, 0, torch.float32)
    target = torch.rand(1, 3, *SIZE)
    renderer = GaussianRenderer()

    def step(means, quats, scales, opacities, colors):
        image = renderer(Gaussians(means, quats, scales, opacities, colors), camera).image
        return photometric_loss(image.clamp(0, 1), target)

    results = []
    torch.compiler.reset()
    for function in (step, torch.compile(step, backend=backend)):
        _, inputs = leaves(gaussians)
        for _ in range(2):
            loss = function(*inputs)
            results.append([loss.detach(), *torch.autograd.grad(loss, inputs)])
    torch.compiler.reset()
    for a, b in zip(results[0] + results[1], results[2] + results[3], strict=True):
        assert (a - b).abs().max() <= 1e-6 * max(1.0, float(a.abs().max()))


def test_transforms_of_functions_are_errors():
    gaussians, camera = random_gaussians(5, 0), random_camera(8, 8, 0)

    def loss(opacities):
        given = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, opacities, gaussians.colors)
        return GaussianRenderer()(given, camera).image.sum()

    with pytest.raises(RuntimeError):
        torch.func.vmap(loss)(gaussians.opacities[None])
    with pytest.raises((RuntimeError, NotImplementedError)):
        torch.func.jvp(loss, (gaussians.opacities,), (torch.ones(5).double(),))
    leaf = gaussians.opacities.clone().requires_grad_()
    value = loss(leaf)
    with pytest.raises(RuntimeError):
        torch.autograd.grad(value, leaf, torch.ones(3).double(), is_grads_batched=True)
    with pytest.raises(RuntimeError, match="second derivative"):
        torch.autograd.grad(loss(leaf), leaf, create_graph=True)
