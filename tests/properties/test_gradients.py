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


@pytest.mark.slow
def test_gradcheck_of_every_single_number():
    inputs = make_inputs(7, sh_degree=1)
    weights = weights_like(render(inputs, **EXACT).image)

    def loss(*values):
        return (render(values, **EXACT).image * weights).sum()

    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


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


@pytest.mark.parametrize("h", [1e-3, 0.04, 0.5])
@pytest.mark.parametrize("name", ["opacities", "colors"])
@pytest.mark.parametrize("seed", [0, 1])
def test_one_step_of_any_length_is_the_derivative(name, h, seed):
    # B5: without thresholds and clamps the image is affine in every single opacity and colour
    inputs = make_inputs(seed, sh_degree=None)
    with torch.no_grad():
        inputs[3].mul_(0.45)
    where = INPUTS.index(name)
    start = render(inputs, **EXACT).image
    weights = weights_like(start, seed)
    (gradient,) = torch.autograd.grad((start * weights).sum(), inputs[where])
    for i in range(gradient.numel()):
        moved = inputs[where].detach().clone()
        moved.view(-1)[i] += h
        end = render([*inputs[:where], moved, *inputs[where + 1 :]], **EXACT).image
        slope = ((end - start) * weights).sum() / h
        assert slope.item() == pytest.approx(gradient.view(-1)[i].item(), abs=1e-12 * max(1, 1e-2 / h))


# --- identities -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [EXACT, {}])
@pytest.mark.parametrize("seed", range(3))
def test_moving_the_world_is_moving_the_camera_and_scaling_both_changes_nothing(seed, options):
    inputs = make_inputs(seed, n=30, size=(24, 24))
    found = gradients(inputs, size=(24, 24), **options)
    rotation = inputs[5][0, :3, :3].detach()
    moved = found[0].sum(0)
    assert moved.abs().max() > 1e-3
    assert (moved - rotation.T @ found[5][0, :3, 3]).abs().max() <= 1e-10 * found[0].abs().sum()
    terms = [(inputs[i] * found[i]).sum() for i in (0, 2)]
    terms.append((inputs[5] * found[5])[0, :3, 3].sum())
    assert max(abs(term) for term in terms) > 1e-2
    assert abs(sum(terms)) <= 1e-10 * sum(abs(term) for term in terms)


@pytest.mark.usefixtures("each_backend")
@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-6), (torch.float64, 1e-14)])
def test_gradient_of_a_quaternion_is_tangential(dtype, bound):
    inputs = make_inputs(0, n=30, size=(24, 24), dtype=dtype)
    found = gradients(inputs, size=(24, 24))[1]
    inner = (inputs[1] * found).sum(1).abs()
    assert found.any()
    assert (inner <= bound * found.norm(dim=1).max() * inputs[1].norm(dim=1)).all()


def test_turning_the_world_is_turning_the_camera():
    # dL along mu -> W mu, q -> (1, w/2) q, [R | t] -> [R (I - W) | t] vanishes for every skew W
    inputs = make_inputs(3, n=30, sh_degree=0, size=(24, 24))
    found = gradients(inputs, size=(24, 24), **EXACT)
    rotation = inputs[5][0, :3, :3]
    w, v = inputs[1][:, :1], inputs[1][:, 1:]
    for axis in torch.eye(3, dtype=torch.float64):
        skew = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, dtype=torch.float64)).T  # skew @ x = axis x x
        turned = torch.cat([-v @ axis[:, None], w * axis + torch.linalg.cross(axis.expand_as(v), v)], 1) / 2
        terms = [
            (found[0] * (inputs[0] @ skew.T)).sum(),
            (found[1] * turned).sum(),
            -(found[5][0, :3, :3] * (rotation @ skew)).sum(),
        ]
        assert max(abs(term) for term in terms) > 1e-3
        assert abs(sum(terms)) <= 1e-9 * sum(abs(term) for term in terms)


# --- contracts --------------------------------------------------------------------------------------------------


def test_two_renders_before_one_backward():
    first, second = make_inputs(0, n=20, size=(20, 20)), make_inputs(0, n=20, size=(20, 20))
    with torch.no_grad():
        second[5][0, :3, 3] += 0.1
    second[:5] = first[:5]
    images = [render(inputs, size=(20, 20)).image for inputs in (first, second)]
    joint = torch.autograd.grad(sum((image * weights_like(image)).sum() for image in images), first[:5])
    apart = [gradients(inputs, size=(20, 20))[:5] for inputs in (first, second)]
    for got, a, b in zip(joint, *apart, strict=True):
        assert (got - (a + b)).abs().max() <= 1e-14 * got.abs().max()


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
