"""The backward pass: finite differences, identities that hold for any loss, and the contracts of autograd."""

import dataclasses
import itertools

import pytest
import torch
from factories import FIELDS, random_camera, random_gaussians, whole_matrices
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType

from kgs import GaussianRenderer, Gaussians, PosedCamera, composite, project

INPUTS = (*FIELDS, "extrinsics", "intrinsics", "background")
EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
SIZE = (8, 8)


def make_inputs(seed, n=5, sh_degree=3, dtype=torch.float64, size=SIZE):
    """Leaves for all that an image depends on, in the order of `INPUTS`.

    All points are within the limits of the footprint's tangents: beyond, the limits are constants by definition, and a
    difference quotient in the intrinsics would see them move.
    """
    gaussians = random_gaussians(n, seed, dtype, sh_degree, image_size=max(size))
    gaussians = dataclasses.replace(gaussians, means=gaussians.means * torch.tensor([0.7, 0.7, 1.0], dtype=dtype))
    camera = random_camera(*size, seed, dtype)
    background = torch.rand(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)
    values = [getattr(gaussians, name) for name in FIELDS]
    values += [camera.extrinsics, camera.intrinsics[:, :2, :3], background]
    return [value.clone().requires_grad_() for value in values]


def render(inputs, size=SIZE, outputs=("image",), **options):
    camera = PinholeCamera(whole_matrices(inputs[6]), inputs[5], torch.tensor([size[0]]), torch.tensor([size[1]]))
    return GaussianRenderer(**options)(Gaussians(*inputs[:5]), camera, inputs[7], outputs)


def weights_like(image, seed=0):
    return torch.randn(image.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(image.dtype)


def gradients(inputs, seed=0, **options):
    image = render(inputs, **options).image
    return torch.autograd.grad((image * weights_like(image, seed)).sum(), inputs)


# --- finite differences -----------------------------------------------------------------------------------------


def check_each_input(run, inputs, seed=0):
    """Along one random direction for each input, the others constant."""
    for i in range(len(inputs)):
        values = [x if i == j else x.detach() for j, x in enumerate(inputs)]
        torch.manual_seed(seed)
        assert torch.autograd.gradcheck(run, values, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True), INPUTS[i]


@pytest.mark.parametrize("sh_degree", [3, None])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 5))])
def test_gradcheck_of_the_whole_pipeline_along_random_directions(seed, sh_degree):
    inputs = make_inputs(seed, sh_degree=sh_degree)

    def run(*values):
        out = render(values, outputs=("image", "alpha", "depth"), **EXACT)
        return out.image, out.alpha, out.depth

    check_each_input(run, inputs, seed)


@pytest.mark.parametrize(
    ("kind", "params"),
    [
        (CameraModelType.PINHOLE, [9.0, 8.5, 3.6, 3.4]),
        (CameraModelType.BROWN_CONRADY, [9.0, 8.5, 3.6, 3.4, 0.1, -0.05, 0.01, 0.02, 0.003, 0.001, 0.002, 0.003]),
        (CameraModelType.KANNALA_BRANDT_K3, [9.0, 8.5, 3.6, 3.4, 0.05, -0.02, 0.01, 0.003]),
        (CameraModelType.ORTHOGRAPHIC, [2.0, 1.8, 3.6, 3.4]),
    ],
)
def test_gradcheck_of_other_lenses(kind, params):
    inputs = make_inputs(2, sh_degree=1)
    inputs[6] = torch.tensor(params, dtype=torch.float64, requires_grad=True)

    def run(*values):
        camera = PosedCamera(CameraModel(ImageSize(*SIZE), kind, values[6]), values[5])
        return GaussianRenderer(**EXACT)(Gaussians(*values[:5]), camera, values[7]).image

    check_each_input(run, inputs)


# --- identities -------------------------------------------------------------------------------------------------


# --- contracts --------------------------------------------------------------------------------------------------


def test_backward_twice():
    inputs = make_inputs(0, n=20, size=(20, 20))
    image = render(inputs, size=(20, 20)).image
    loss = (image * weights_like(image)).sum()
    once = torch.autograd.grad(loss, inputs, retain_graph=True)
    render(make_inputs(1, n=20, size=(20, 20)), size=(20, 20)).image.sum().backward()  # another render in between
    again = torch.autograd.grad(loss, inputs)
    assert all(torch.equal(a, b) for a, b in zip(once, again, strict=True))
    with pytest.raises(RuntimeError, match="backward through the graph a second time"):
        torch.autograd.grad(loss, inputs)


@pytest.mark.parametrize("name", INPUTS)
def test_editing_an_input_before_backward_is_never_silently_wrong(name):
    inputs = make_inputs(0)
    expected = gradients(inputs)
    image = render(inputs).image
    with torch.no_grad():
        inputs[INPUTS.index(name)].mul_(1.1)
    try:
        found = torch.autograd.grad((image * weights_like(image)).sum(), inputs)
    except RuntimeError as refused:
        error = str(refused)
    else:
        error = "" if all(torch.equal(a, b) for a, b in zip(found, expected, strict=True)) else "wrong"
    assert error == "" or "modified by an inplace operation" in error


@pytest.mark.parametrize("name", ["factors", "opacities"])
def test_editing_what_the_backward_pass_needs_raises(name):
    inputs = make_inputs(0)
    projected = project(Gaussians(*inputs[:5]), random_camera(*SIZE, 0))
    leaf = getattr(projected, name).detach().requires_grad_()
    out = composite(dataclasses.replace(projected, **{name: leaf}), projected.colors)
    with torch.no_grad():
        leaf.mul_(1.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        out.features.sum().backward()


def test_every_subset_of_inputs_gets_the_same_values():
    every = make_inputs(0)
    expected = dict(zip(INPUTS, gradients(every, **EXACT), strict=True))
    groups = [(name,) for name in FIELDS] + [("extrinsics", "intrinsics", "background")]
    for size in range(1, len(groups) + 1):
        for chosen in itertools.combinations(groups, size):
            names = {name for group in chosen for name in group}
            inputs = [x.detach().clone().requires_grad_(name in names) for name, x in zip(INPUTS, every, strict=True)]
            image = render(inputs, **EXACT).image
            (image * weights_like(image)).sum().backward()
            for name, x in zip(INPUTS, inputs, strict=True):
                if name in names:
                    assert torch.equal(x.grad, expected[name]), (name, names)
                else:
                    assert x.grad is None
