"""`kgs.rasterization` against gsplat's own torch code, in float64: images and the gradients of everything."""

import pytest
import torch
from factories import batch, random_camera, random_gaussians

from kgs import rasterization

pytest.importorskip("gsplat")
from gsplat.cuda import _torch_impl as gsplat
from gsplat_reference import gsplat_render

pytestmark = pytest.mark.usefixtures("each_backend")

SIZE = (24, 32)  # height, width
EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}


def scene(seed=0, n=50, cameras=2, sh_degree=None, spread=0.5):
    """A scene with gsplat's names, in float64; opacities below the clamps of both.

    A spread of 1 fills the image; with less no footprint ends beside it, where what is seen differs in the last digits.
    """
    gaussians = random_gaussians(n, seed, torch.float64, sh_degree, max(SIZE), opacities=(0.05, 0.9))
    gaussians.means[:, :2] *= spread
    views = batch(*(random_camera(*SIZE, seed + c, torch.float64) for c in range(cameras)))
    k = views.intrinsics[:, :3, :3].clone()
    k[:, :2, 2] += 0.5
    return vars(gaussians) | {"viewmats": views.extrinsics.clone(), "Ks": k}


def leaves(values, dtype):
    return {name: value.detach().to(dtype).requires_grad_() for name, value in values.items()}


def ours(values, **options):
    given = {"quats": None, "scales": None} | values
    return rasterization(**given, width=SIZE[1], height=SIZE[0], **EXACT, **options)


def gradients(values):
    """Those that both define: of a pose without its last row, of a lens by focal lengths and centre."""
    found = {name: value.grad for name, value in values.items() if value.grad is not None}
    found["viewmats"] = found["viewmats"][:, :3]
    found["Ks"] = found["Ks"] * torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    return found


def compare(values, bound=1e-5, packed=False, **options):
    """Images within the bound, and gradients within it of the largest of each."""
    true, own = leaves(values, torch.float64), leaves(values, torch.float32)
    image, alpha, expected = gsplat_render(true, SIZE, **options)
    options = {name: x.float() if isinstance(x, torch.Tensor) else x for name, x in options.items()}
    renders, alphas, meta = ours(own, packed=packed, **options)
    meta["means2d"].retain_grad()
    generator = torch.Generator().manual_seed(3)
    weights = (
        torch.randn(image.shape, generator=generator, dtype=torch.float64),
        torch.randn(alpha.shape, generator=generator),
    )
    if options.get("render_mode", "RGB").endswith("ED"):  # float32 has 1 - T to 6e-8: not to 1e-5 where it is small
        weights[0][..., -1:] *= alpha.detach() > 0.1
    ((image * weights[0]).sum() + (alpha * weights[1]).sum()).backward()
    ((renders * weights[0]).sum() + (alphas * weights[1]).sum()).backward()
    scale = image.detach().abs().max().clamp_min(1.0)
    assert ((renders - image) * (weights[0] != 0)).abs().max() <= bound * scale
    assert (alphas - alpha).abs().max() <= bound
    wanted, found = gradients(true), gradients(own)
    for name, value in wanted.items():
        assert (found[name] - value).abs().max() <= 2 * bound * value.abs().max(), name
    if not packed:
        gradient = expected["means2d"].grad
        wrong = (meta["means2d"].grad - gradient) * expected["lies"][..., None]
        assert wrong.abs().max() <= 2 * bound * gradient.abs().max()
    return true, own, meta


@pytest.mark.parametrize("camera_model", ["pinhole", "fisheye", "ortho"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_lenses_and_anti_aliasing(camera_model, rasterize_mode):
    values = scene()
    if camera_model == "ortho":
        values["Ks"][:, :2, :2] /= 4
    compare(values, camera_model=camera_model, rasterize_mode=rasterize_mode)


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("packed", [True, False])
def test_modes_with_backgrounds(mode, packed):
    backgrounds = torch.rand(2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    options = {} if mode in ("D", "ED") else {"backgrounds": backgrounds}
    compare(scene(), render_mode=mode, packed=packed, **options)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_up_to_a_degree(degree):
    compare(scene(sh_degree=3), sh_degree=degree)


@pytest.mark.parametrize("width", [1, 2, 7])
@pytest.mark.parametrize("own", [False, True], ids=["for all cameras", "for each camera"])
def test_features_of_any_width(width, own):
    features, backgrounds = torch.randn(2, 50, width).double(), torch.randn(2, width).double()
    compare(scene() | {"colors": features if own else features[0]}, backgrounds=backgrounds)


def test_opacities_of_each_camera():
    values = scene(sh_degree=1)
    own = torch.stack([values["opacities"], values["opacities"].flip(0)])
    compare(values | {"opacities": own}, sh_degree=1)


def test_harmonics_are_seen_from_the_centre_through_a_fisheye():
    values = scene(sh_degree=2)
    compare(values, sh_degree=2, camera_model="fisheye")


def test_a_feature_of_one_camera_that_is_not_finite_leaves_its_gaussian_out():
    values = {name: value.float() for name, value in scene().items()}
    values["colors"] = torch.rand(2, 50, 4, generator=torch.Generator().manual_seed(5))
    values["colors"][1, 7, 2] = torch.nan
    renders, _, meta = ours(values)
    assert renders.isfinite().all()
    assert 7 not in meta["gaussian_ids"]
    rest = torch.arange(50) != 7
    kept = {name: value[rest] if len(value) == 50 else value for name, value in values.items()}
    again, _, _ = ours(kept | {"colors": values["colors"][:, rest]})
    assert torch.allclose(renders, again, atol=1e-6)


def test_gaussians_beyond_the_limits_of_the_jacobian():
    """The limits follow the lens, and so do its gradients."""
    values = scene(spread=1.0)
    values["means"][:6, 0] = torch.tensor([-5.5, 4.0, -5.0, 5.0, -4.5, 4.5])
    values["scales"][:6] = 1.0
    _, own, _ = compare(values)
    point = values["means"][:6] @ values["viewmats"][0, :3, :3].mT + values["viewmats"][0, :3, 3]
    assert (values["Ks"][0, 0, 0] * point[:, 0] / point[:, 2]).abs().min() > 1.3 * SIZE[1] / 2
    assert own["Ks"].grad[:, 0, 0].any()


def test_poses_that_are_rounded_scaled_or_sheared():
    values = scene(sh_degree=2)
    for change in (torch.eye(3) * 1.0004, torch.tensor([[1.0, 0.2, 0.0], [0.0, 0.9, -0.1], [0.1, 0.0, 1.2]])):
        moved = values["viewmats"].clone()
        moved[:, :3, :3] = change.double() @ moved[:, :3, :3]
        compare(values | {"viewmats": moved}, sh_degree=2)
    compare(values | {"viewmats": (values["viewmats"] * 1e4).round() / 1e4}, sh_degree=2)


def test_what_lies_behind_the_far_plane_or_is_too_small_is_not_drawn():
    values = scene(n=80)
    values["scales"][::3] *= 0.05
    _, _, meta = compare(values, far_plane=4.5, radius_clip=3.0)
    everything = ours(values, packed=False)[2]
    missing = (everything["radii"] > 0).all(-1) & ~(meta["radii"] > 0).all(-1)
    assert 10 < missing.sum() < 130
    assert ((everything["depths"] >= 4.5) | (everything["radii"] <= 3).all(-1))[missing].all()
    assert (meta["depths"] < 4.5).all()


def covariances(values):
    covars, _ = gsplat._quat_scale_to_covar_preci(values.pop("quats"), values.pop("scales"), True, False)
    return values | {"covars": covars}


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("part", [torch.clone, torch.triu], ids=["whole", "upper triangle"])
def test_covariances(part, mode):
    values = covariances(scene())
    compare(values | {"covars": part(values["covars"])}, rasterize_mode=mode)


def needles(n, ratio):
    """Needles in all directions before one camera, with their covariances in float64."""
    values = scene(n=n, cameras=1)
    values["scales"] = torch.tensor([0.5, 0.5 / ratio, 0.5 / ratio], dtype=torch.float64).repeat(n, 1)
    covars, _ = gsplat._quat_scale_to_covar_preci(values["quats"], values["scales"], True, False)
    return values, covars


def test_covariances_of_needles_are_factored_without_loss():
    """Of 1e5 : 1, 0.4 pixels thin: the covariance, 1e10 : 1, knows the width to 1e-6 in float64."""
    values, _ = needles(20, 10.0)
    values["scales"] = torch.tensor([5e3, 0.05, 0.05], dtype=torch.float64).repeat(20, 1)
    covars, _ = gsplat._quat_scale_to_covar_preci(values["quats"], values["scales"], True, False)
    expected = ours(values, eps2d=0.01)[0]
    del values["quats"], values["scales"]
    renders = ours(values | {"covars": covars}, eps2d=0.01)[0]
    assert (renders - expected).abs().max() < 1e-5
    assert renders.max() > 0.1


@pytest.mark.parametrize(("ratio", "bound"), [(1.0, 1e-5), (10.0, 1e-5), (100.0, 1e-4)])
def test_gradients_of_covariances_of_needles(ratio, bound):
    values, covars = needles(30, ratio)
    del values["quats"], values["scales"]
    compare(values | {"covars": covars}, bound)


def test_flat_and_empty_covariances_are_drawn():
    """Their gradient is finite: 0 along axes of length 0, which a factor cannot know."""
    values, covars = needles(3, 10.0)
    covars[0] = 0.0
    covars[1] = torch.diag(torch.tensor([0.04, 0.0, 0.01]))
    covars[2] = torch.diag(torch.tensor([0.0, 0.04, 0.01]))
    own = leaves(values, torch.float32) | {"quats": None, "scales": None, "covars": covars.float().requires_grad_()}
    image = gsplat_render(leaves(values | {"covars": covars}, torch.float64), SIZE)[0]
    renders = ours(own)[0]
    assert (renders - image).abs().max() < 1e-5
    renders.square().sum().backward()
    assert own["covars"].grad.isfinite().all()
    assert own["covars"].grad[1, 0, 0] != 0
    assert not own["covars"].grad[0].any()
