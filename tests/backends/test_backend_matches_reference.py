"""Each backend of kernels against torch in float64: backend, stage, case; forward and gradient."""

import copy
import math

import pytest
import torch
from compositing_checks import TH, THRESHOLDS, assert_close, exact, footprints, outcome, random, sample
from factories import (
    FIELDS,
    LENS_PARAMS,
    batch,
    posed,
    random_camera,
    random_gaussians,
    random_model,
    replace,
    with_camera,
)
from kornia.losses import ssim_loss
from kornia.sensors.camera import CameraModelType
from projection_checks import assert_alike, wide_scene
from targets import TORCH, TRITON, on_kernels

from kgs import GaussianRenderer, project
from kgs.backends import BACKENDS
from kgs.losses import photometric_loss, target_moments

# -- projection ----------------------------------------------------------------------------------------------------

CAMERA = ("extrinsics", "intrinsics")


def with_colors(width):
    return lambda gaussians, cameras: (replace(gaussians, colors=torch.rand(len(gaussians), width)), cameras)


def of_each_camera(gaussians, cameras):
    return replace(gaussians, opacities=torch.rand(2, len(gaussians))), cameras


def strong(opacity, finite):
    """One of the Gaussians is very opaque: all are seen in a wider footprint, unless it is not finite."""

    def change(gaussians, cameras):
        gaussians.opacities[3] = opacity
        gaussians.means[3, 0] *= 1.0 if finite else torch.inf
        return gaussians, cameras

    return change


def with_lens(*block):
    """Another 2 x 2 block of the intrinsics: skew, negative focal lengths."""

    def change(gaussians, cameras):
        intrinsics = cameras.intrinsics.clone()
        intrinsics[:, :2, :2] = torch.tensor(block).view(2, 2)
        return gaussians, with_camera(cameras, intrinsics=intrinsics)

    return change


def with_pose(*matrix):
    """Poses that are scaled or sheared."""

    def change(gaussians, cameras):
        extrinsics = cameras.extrinsics.clone()
        extrinsics[:, :3, :3] = torch.tensor(matrix).view(3, 3) @ extrinsics[:, :3, :3]
        return gaussians, with_camera(cameras, extrinsics=extrinsics)

    return change


def with_scales(*factors):
    return lambda gaussians, cameras: (replace(gaussians, scales=gaussians.scales * torch.tensor(factors)), cameras)


def flat(gaussians, cameras):
    gaussians.scales[::2, 1] = 0.0
    return gaussians, cameras


def none(gaussians, cameras):
    return gaussians[:0], cameras


def behind(gaussians, cameras):
    return replace(gaussians, means=-gaussians.means.abs() - 100), cameras


# arguments of `wide_scene`, how they are changed, options
PROJECTIONS = {
    "colors": {"degree": None, "few": 120},
    "harmonics of degree 0": {"degree": 0, "few": 120},
    "harmonics of degree 1, two cameras": {"degree": 1, "few": 120, "cameras": 2},
    "harmonics of degree 2": {"degree": 2, "few": 120},
    "harmonics of degree 3, three cameras": {"degree": 3, "few": 120, "cameras": 3},
    "needles": {"n": 120, "change": with_scales(1e3, 1e-3, 1.0)},
    "flat": {"n": 120, "change": flat},
    "near plane": {"degree": 1, "n": 100, "near_plane": 4.0},
    "no eps2d": {"degree": 1, "n": 100, "eps2d": 0.0},
    "wide eps2d, tiny near plane": {"degree": 1, "n": 100, "eps2d": 2.5, "near_plane": 1e-6},
    "frame": {"degree": 1, "n": 100, "frame": (10.0, 8.0, 40.0, 30.0)},
}
SELDOM_PROJECTED = {
    f"{width} features, two cameras": {"degree": None, "n": 100, "cameras": 2, "change": with_colors(width)}
    for width in (0, 1, 7, 17)
}
SELDOM_PROJECTED |= {
    "opacities of each camera": {"degree": None, "n": 100, "cameras": 2, "change": of_each_camera},
    "skew": {"n": 100, "change": with_lens(50.0, 4.0, 0.0, 60.0)},
    "negative focal length": {"n": 100, "change": with_lens(-50.0, 0.0, 0.0, 60.0)},
    "anisotropic block": {"n": 100, "change": with_lens(50.0, 4.0, -3.0, -60.0)},
    "gradients of intrinsics": {"n": 100, "cameras": 2, "wanted": CAMERA[1:]},
}
for _degree in (None, 3):
    SELDOM_PROJECTED[f"no colors of degree {_degree}"] = {"degree": _degree, "n": 60, "colors": False}
    for _wanted in (CAMERA[:1], (*CAMERA, *FIELDS)):
        name = f"gradients of {' '.join(_wanted)} of degree {_degree}"
        PROJECTIONS[name] = {"degree": _degree, "few": 30, "cameras": 2, "wanted": _wanted}
        PROJECTIONS[name] |= {"change": with_lens(50.0, 3.0, -2.0, 60.0)}
for _degree in (None, 0, 3):
    PROJECTIONS[f"no Gaussians of degree {_degree}"] = {"degree": _degree, "n": 30, "cameras": 2, "change": none}
    PROJECTIONS[f"all behind, of degree {_degree}"] = {"degree": _degree, "n": 30, "cameras": 2, "change": behind}
for _wanted in (FIELDS, CAMERA):
    for _kind, _pose in (("scaled", 1.7 * torch.eye(3)), ("sheared", ((1, 0.2, 0), (0, 0.9, -0.1), (0.1, 0, 1.2)))):
        _change = with_pose(*torch.as_tensor(_pose).flatten().tolist())
        case = {"degree": 3, "few": 30, "change": _change, "wanted": _wanted}
        SELDOM_PROJECTED[f"{_kind} pose, gradients of {_wanted[0]}"] = case
for _opacity in (0.0, 1.9, 2.1, 50.0):
    for _finite in (True, False):
        for _threshold in (1 / 255, 0.3, 0.0):
            name = f"an opacity of {_opacity} that is {'' if _finite else 'not '}finite, threshold {_threshold:g}"
            case = {"degree": 1, "n": 100, "change": strong(_opacity, _finite), "alpha_threshold": _threshold}
            SELDOM_PROJECTED[name] = case
for _field in FIELDS:
    SELDOM_PROJECTED[f"{_field} alone"] = {"degree": 1, "n": 60, "wanted": (_field,), "accuracy": 1e-5}


@on_kernels(PROJECTIONS, SELDOM_PROJECTED)
def test_projection(kernels, case, handed_over):
    given = {"degree": 2, "n": 400, "few": 400, "cameras": 1, "change": lambda *scene: scene} | case
    degree, n, few, cameras, change = (given.pop(key) for key in ("degree", "n", "few", "cameras", "change"))
    got, grads = assert_alike(*change(*wide_scene(degree, kernels.few(n, min(n, few)), cameras)), kernels, **given)
    assert not handed_over or change is none
    if change in (none, behind):
        assert len(got) == 0
        assert all(grads[name] is not None and not grads[name].any() for name in FIELDS)
    if not given.get("colors", True):
        assert got.colors.shape == (len(got), 0)
        assert grads["colors"] is None


# -- compositing ---------------------------------------------------------------------------------------------------


def ordinary(width=5, size=(40, 56), count=300, few=(12, (5, 9)), **options):
    """Footprints of an ordinary scene; where float32 cannot change a decision; the picture ends within tiles."""

    def make(kernels):
        thresholds = (options.get("alpha_threshold", TH), options.get("transmittance_stop", THRESHOLDS[0][1]))
        projected, certain = sample(*(few if kernels.interpreted else (count, size)), thresholds)
        return projected, random(len(projected), width), certain, options, ()

    return make


def two_cameras_in_slices(kernels):
    gaussians = random_gaussians(10, 1, torch.float32, None, 16, (0.05, 1.0))
    projected = project(gaussians, batch(*(random_camera(16, 11, seed, torch.float32) for seed in range(2))))
    options = {"alpha_threshold": 0.0, "transmittance_stop": 0.0, "max_bytes": 2**13}
    return projected, random(len(projected), 5), None, options, ()


def opacity(value, threshold):
    def make(kernels):
        layers = footprints([value, 0.5], [[5.2, 4.1], [7.0, 3.0]], 2 * random(2, 2, 3), size=(8, 11), eps2d=0.3)
        bounds = (2e-5, 2e-6 + 1e-6 * max(0, math.log2(min(value, 1e38))))
        return layers, random(2, 3), None, {"alpha_threshold": threshold}, bounds

    return make


def needle(length, turn):
    """Needles, and a footprint that is wider than the picture."""

    def make(kernels):
        c, s = math.cos(turn), math.sin(turn)
        thin = [[c * length, -s * 0.2, 0.0], [s * length, c * 0.2, 0.0]]
        factors = torch.tensor([thin, [[length, 0.0, 0.0], [0.0, length, 0.0]], thin])
        layers = footprints([0.6, 0.3, 0.9], [[5.3, 4.2], [3.0, 3.0], [9.0, 7.0]], factors, size=(9, 12), eps2d=0.3)
        return layers, random(3, 3), None, {"alpha_threshold": 0.0, "transmittance_stop": 0.0}, (5e-5, 1e-5)

    return make


def unseen(kernels):
    layers = footprints([0.0, 0.5], [[5.0, 4.0], [500.0, 4.0]], random(2, 2, 3), size=(9, 11))
    return layers, random(2, 3), None, {}, ()


def dark_after_six(kernels):
    return footprints([0.8] * 60, size=(5, 3)), random(60, 3), None, {}, ()


COMPOSITINGS = {
    f"thresholds {th:g}, {stop:g}": ordinary(few=(14, (12, 13)), alpha_threshold=th, transmittance_stop=stop)
    for th, stop in THRESHOLDS
}
COMPOSITINGS |= {"no Gaussians": ordinary(3, (9, 11), 0, (0, (9, 11))), "no entries": unseen}
SELDOM_COMPOSITED = {f"{width} features": ordinary(width) for width in (0, 1, 4, 5, 8, 9, 11, 20)}
SELDOM_COMPOSITED |= {
    f"an image of {size}": ordinary(3, size, 60, (12, size)) for size in ((8, 8), (11, 5), (1, 1), (3, 100))
}
SELDOM_COMPOSITED |= {
    f"an opacity of {value}, threshold {threshold:g}": opacity(value, threshold)
    for value in (1e-30, 0.5, 0.99, 1.0, 2.0, 1e6, 1e38, torch.inf)
    for threshold in (0.0, TH)
}
SELDOM_COMPOSITED |= {
    f"needles of {length:g} px, turned by {turn:.1f}": needle(length, turn)
    for length in (30.0, 1e4)
    for turn in (0.0, 0.6, math.pi / 2)
}
SELDOM_COMPOSITED |= {"two cameras in row slices": two_cameras_in_slices, "dark after six layers": dark_after_six}


@on_kernels(COMPOSITINGS, SELDOM_COMPOSITED)
def test_compositing(kernels, case):
    projected, features, certain, options, bounds = case(kernels)
    found = outcome(projected, features, certain, kernels, **options)
    options.pop("max_bytes", None)
    assert_close(found, exact(projected, features, certain, **options), certain, *bounds)
    if case is unseen or not len(projected):
        assert (found[0][1] == 1).all()
        assert not any(x.any() for x in (found[0][0], found[0][2], *found[1]))


# -- projection in torch and compositing: what has no projection in kernels -------------------------------------------


@on_kernels({}, {kind.name: kind for kind in CameraModelType})
def test_render_through_a_lens(kernels, case):
    gaussians, images = random_gaussians(kernels.few(100, 12), 2, torch.float32, 1), []
    for target, dtype in ((kernels, torch.float32), (TORCH, torch.float64)):
        lens = target.move(torch.tensor(LENS_PARAMS[case]), dtype)
        camera = posed(case, lens, extrinsics=target.move(torch.eye(4)[None], dtype))
        images.append(GaussianRenderer(backend=target.backend)(target.move(gaussians, dtype), camera).image.cpu())
    assert (images[0] - images[1]).abs().max() <= 1e-5 * images[1].abs().max()


# -- loss ----------------------------------------------------------------------------------------------------------

SHAPES = [(1, 3, 16, 11), (1, 2, 33, 129), (3, 1, 27, 12), (1, 4, 70, 43)]
LOSSES = {f"{shape}": (shape, 0.2) for shape in ((1, 1, 11, 11), (2, 3, 11, 17))}
SELDOM_LOSSES = {f"{shape}, weight {weight}": (shape, weight) for shape in SHAPES for weight in (0.2, 3.0)}


@on_kernels(LOSSES, SELDOM_LOSSES)
def test_loss(kernels, case):
    """Kornia's in float64."""
    shape, weight = case
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(shape, generator=generator)
    image = (target + 0.2 * torch.randn(shape, generator=generator)).clamp(0, 1)
    image[..., ::2, 3:5] = target[..., ::2, 3:5]  # no slope where they are equal
    leaf, photo = kernels.move(image).requires_grad_(), kernels.move(target)
    value = photometric_loss(leaf, photo, weight, moments=target_moments(photo), backend=kernels.backend)
    value.backward()
    reference = image.double().requires_grad_()
    expected = (reference - target).abs().mean() + 2 * weight * ssim_loss(reference, target.double(), 11)
    expected.backward()
    assert (value.dtype, value.shape) == (torch.float32, ())
    assert abs(value - expected) <= 1e-6 * expected
    assert (leaf.grad.cpu() - reference.grad).abs().max() <= 2e-6 * reference.grad.abs().max()


# -- activations and blending, which Triton has --------------------------------------------------------------------

OUTPUTS = ("scales", "opacities", "colors")
ACTIVATIONS = {f"degree {k} of {highest}": {"highest": highest, "degree": k} for highest, k in ((3, 3), (3, 1), (2, 2))}
ACTIVATIONS |= {f"degree 0 of {highest}": {"highest": highest, "degree": 0} for highest in (1, 0)}
ACTIVATIONS |= {f"{n} Gaussians": {"n": n, "highest": 1, "degree": 1} for n in (0, 1, 257)}
ACTIVATIONS |= {f"by {names}": {"n": 40, "names": names} for names in (*((x,) for x in OUTPUTS), OUTPUTS[::2])}
ACTIVATIONS |= {
    f"{name} frozen": {"n": 40, "frozen": name} for name in ("log_scales", "opacity_logits", "sh_dc", "sh_rest")
}
ACTIVATIONS |= {"parameters in another order in memory": {"n": 40, "transposed": True}}
ACTIVATIONS |= {f"{name} that is NaN": {"n": 40, "nan": name} for name in ("log_scales", "opacity_logits")}


def activated(model, backend, names):
    """Scales, opacities and colours, and the gradients of all parameters by those that are named."""
    gaussians = model(backend=backend)
    for seed, name in enumerate(names):
        output = getattr(gaussians, name)
        weights = torch.randn(output.shape, generator=torch.Generator().manual_seed(seed)).to(output)
        if output.requires_grad:
            output.backward(weights, retain_graph=True)
    values = [getattr(gaussians, name).detach() for name in OUTPUTS]
    return values, {name: x.grad for name, x in model.named_parameters()}


@TRITON
@pytest.mark.parametrize("case", ACTIVATIONS.values(), ids=ACTIVATIONS)
def test_activation(kernels, case):
    given = {
        "n": 300,
        "highest": 3,
        "degree": 3,
        "names": OUTPUTS,
        "frozen": None,
        "transposed": False,
        "nan": None,
    } | case
    model = random_model(given["n"], given["highest"]).to(kernels.device)
    model.sh_degree = given["degree"]
    with torch.no_grad():
        model.log_scales.mul_(4.0).sub_(3.0)
        model.opacity_logits.mul_(5.0)
        if given["nan"]:
            model.get_parameter(given["nan"])[7] = math.nan
    for parameter in model.parameters() if given["transposed"] else ():
        parameter.data = parameter.data.transpose(0, -1).contiguous().transpose(0, -1)
    if given["frozen"]:
        model.get_parameter(given["frozen"]).requires_grad_(False)
    values, gradients = activated(model, kernels.backend, given["names"])
    expected, right = activated(copy.deepcopy(model).double(), "torch", given["names"])
    assert [x is None for x in gradients.values()] == [x is None for x in right.values()]
    for value, double in zip(values, expected, strict=True):
        assert value.is_contiguous()
        torch.testing.assert_close(value, double.float(), rtol=5e-7, atol=1e-37, equal_nan=True)
    for name in [name for name, x in gradients.items() if x is not None]:
        lost = 2e-7 if name == "opacity_logits" else 1e-37  # 1 - opacity, where that is nearly 1
        assert gradients[name].is_contiguous() or given["transposed"]
        torch.testing.assert_close(gradients[name], right[name].float(), rtol=5e-7, atol=lost)
    assert not given["nan"] or not gradients[given["nan"]][7].any()


BACKGROUNDS = {  # of 3 channels and 2 images, but for the first
    "one colour, seven channels": torch.linspace(-1, 2, 7)[:, None, None],
    "one colour": torch.linspace(-1, 2, 3)[:, None, None],
    "a colour for each image": torch.linspace(-1, 2, 6).view(2, 3, 1, 1),
    "a picture": torch.linspace(-1, 2, 3 * 13 * 31).view(3, 13, 31),
}
BACKGROUNDS |= {f"{shape}": torch.full(shape, 0.7) for shape in ((1, 1, 1), (1, 3, 1, 1), (2, 1, 1, 1), (1, 1))}
BACKGROUNDS |= {"an infinite colour": torch.tensor([math.inf, 0.5, -math.inf])[:, None, None]}


@TRITON
@pytest.mark.parametrize("name", BACKGROUNDS)
def test_blending(kernels, name):
    background = BACKGROUNDS[name]
    generator = torch.Generator().manual_seed(0)
    shapes = [(2, 7 if len(background) == 7 else 3, 13, 31), (2, 1, 13, 31)]
    image, transmittance = (torch.rand(shape, generator=generator) for shape in shapes)
    transmittance[:, :, 3:6] = 0.0
    weights = torch.rand(shapes[0], generator=generator)
    found = []
    for table, dtype in ((BACKENDS[kernels.backend], torch.float32), (BACKENDS["torch"], torch.float64)):
        inputs = [kernels.move(x, dtype).requires_grad_() for x in (image, transmittance)]
        blended = table.blend(*inputs, kernels.move(background, dtype))
        found.append([blended, *torch.autograd.grad(blended, inputs, kernels.move(weights, dtype))])
    for got, expected in zip(*found, strict=True):
        torch.testing.assert_close(got, expected.float(), rtol=1e-6, atol=1e-7, equal_nan=True)
    assert found[0][0][:, :, 3:6].isfinite().all()  # where no light is left nothing shows
