"""gsplat's call: against the renderer and the dense reference, and what it refuses."""

import enum
import inspect

import pytest
import torch
from factories import FIELDS, batch, leaves, random_camera, random_gaussians, replace

import kgs
import kgs.reference
from kgs import GaussianRenderer, rasterization

pytestmark = pytest.mark.usefixtures("each_backend")

SIZE = (24, 32)
POSITIONAL = [  # gsplat's, in its order
    *("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"),
    *("width", "height", "near_plane", "far_plane", "radius_clip", "eps2d", "sh_degree"),
    *("packed", "tile_size", "backgrounds", "render_mode", "sparse_grad", "absgrad"),
    *("rasterize_mode", "channel_chunk", "distributed", "camera_model"),
]


class RollingShutter(enum.Enum):
    """As gsplat's."""

    ROLLING_TOP_TO_BOTTOM = 0
    GLOBAL = 4


GSPLAT_DEFAULTS = {  # of 1.6
    **{"near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3, "sh_degree": None, "packed": True},
    **{"tile_size": None, "backgrounds": None, "render_mode": "RGB", "sparse_grad": False, "absgrad": False},
    **{"rasterize_mode": "classic", "distributed": False, "camera_model": "pinhole", "segmented": False},
    **{"covars": None, "with_ut": False, "with_eval3d": False, "macro_tile": False, "return_normals": False},
    **{"global_z_order": True, "rays": None, "radial_coeffs": None, "tangential_coeffs": None},
    **{"thin_prism_coeffs": None, "ftheta_coeffs": None, "lidar_coeffs": None, "external_distortion_coeffs": None},
    **{"rolling_shutter": RollingShutter.GLOBAL, "viewmats_rs": None, "ut_params": None, "extra_signals": None},
    **{"extra_signals_sh_degree": None, "renderer_config": None},
}


def scene(sh_degree=None, dtype=torch.float64, cameras=2):
    gaussians = random_gaussians(60, 0, dtype, sh_degree, 32)
    return gaussians, batch(*(random_camera(*SIZE, seed, dtype) for seed in range(cameras)))


def call(gaussians, cameras, half=True, **options):
    """With intrinsics as gsplat has them, and as kgs does."""
    k = cameras.intrinsics[:, :3, :3].clone()
    k[:, :2, 2] += 0.5 if half else 0.0
    arguments = {name: getattr(gaussians, name) for name in FIELDS} | options
    centers = {} if half else {"pixel_centers": "integer"}
    return rasterization(viewmats=cameras.extrinsics, Ks=k, width=32, height=24, **centers, **arguments)


@pytest.mark.usefixtures("torch_alone")
def test_the_names_and_their_order_are_gsplats():
    assert list(inspect.signature(rasterization).parameters)[: len(POSITIONAL)] == POSITIONAL


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
@pytest.mark.parametrize("half", [True, False])
def test_renders_are_those_of_the_renderer(half, dtype, bound):
    gaussians, cameras = scene(dtype=dtype)
    out = GaussianRenderer()(gaussians, cameras, outputs=("image", "alpha", "depth"))
    renders, alphas, meta = call(gaussians, cameras, half, render_mode="RGB+ED")
    assert renders.shape == (2, 24, 32, 4)
    assert alphas.shape == (2, 24, 32, 1)
    assert (renders[..., :3] - out.image.permute(0, 2, 3, 1)).abs().max() <= bound
    assert (alphas - out.alpha.permute(0, 2, 3, 1)).abs().max() <= bound
    covered = out.alpha.permute(0, 2, 3, 1) > 1e-3
    assert ((renders[..., 3:] - out.depth.permute(0, 2, 3, 1)) * covered).abs().max() <= 100 * bound
    seen = out.projected
    for name in ("camera_ids", "gaussian_ids"):
        assert torch.equal(meta[name], getattr(seen, name))
    for name in ("depths", "opacities", "conics"):
        assert torch.allclose(meta[name], getattr(seen, name))
    assert (meta["means2d"] - seen.means2d - (0.5 if half else 0.0)).abs().max() <= 1e-4
    assert (meta["width"], meta["height"], meta["tile_size"], meta["n_cameras"]) == (32, 24, 8, 2)


def test_a_point_lands_where_its_intrinsics_say():
    gaussians, cameras = scene(cameras=1)
    _, _, meta = call(gaussians, cameras)
    k = cameras.intrinsics[0, :3, :3].clone()
    k[:2, 2] += 0.5
    points = gaussians.means @ cameras.extrinsics[0, :3, :3].T + cameras.extrinsics[0, :3, 3]
    pixels = (points @ k.T)[meta["gaussian_ids"]]
    assert torch.allclose(meta["means2d"], pixels[:, :2] / pixels[:, 2:])


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_the_modes_are_what_the_weights_of_the_reference_say(mode, exactly):
    dtype, bound = exactly
    gaussians, cameras = scene(cameras=1, dtype=dtype)
    exact = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}
    drawn = kgs.reference.layers(gaussians, cameras, **exact)
    color = torch.einsum("lhw,lc->hwc", drawn.weights, drawn.colors)
    depth = torch.einsum("lhw,l->hw", drawn.weights, drawn.depths)[..., None]
    alpha = (1 - drawn.transmittance)[..., None]
    parts = {"RGB": color, "D": depth, "ED": depth / alpha}
    renders, alphas, _ = call(gaussians, cameras, render_mode=mode, **exact)
    assert torch.allclose(
        renders[0], torch.cat([parts[part] for part in mode.split("+")], 2).to(dtype), atol=20 * bound
    )
    assert torch.allclose(alphas[0], alpha.to(dtype), atol=bound)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_up_to_a_degree(degree, exactly):
    dtype, bound = exactly
    gaussians, cameras = scene(3, dtype)
    lower = replace(gaussians, colors=gaussians.colors[:, : (degree + 1) ** 2])
    expected = GaussianRenderer()(lower, cameras).image.permute(0, 2, 3, 1)
    assert torch.allclose(call(gaussians, cameras, sh_degree=degree)[0], expected, atol=bound)


@pytest.mark.parametrize("width", [1, 2, 7])
@pytest.mark.parametrize("own", [False, True])
def test_features_of_any_width_also_one_set_per_camera(width, own, exactly):
    dtype, bound = exactly
    gaussians, cameras = scene(dtype=dtype)
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(2, 60, width, generator=generator, dtype=dtype)
    backgrounds = torch.randn(2, width, generator=generator, dtype=dtype)
    leaf = (features if own else features[0]).clone().requires_grad_()
    renders, _, _ = call(gaussians, cameras, colors=leaf, backgrounds=backgrounds)
    for c in range(2):
        padded = torch.cat([features[c if own else 0], torch.zeros(60, 6 - width if width < 6 else 2)], 1)
        bright = torch.cat([backgrounds[c], torch.zeros(len(padded[0]) - width, dtype=dtype)])
        for first in range(0, width, 3):
            part = replace(gaussians, colors=padded[:, first : first + 3])
            single = random_camera(*SIZE, c, dtype)
            image = GaussianRenderer()(part, single, bright[first : first + 3]).image[0].permute(1, 2, 0)
            assert torch.allclose(renders[c, :, :, first : first + 3], image[..., : width - first], atol=bound)
    renders.square().sum().backward()
    assert leaf.grad.isfinite().all()
    assert leaf.grad.reshape(-1, 60, width).flatten(1).any(1).all()


@pytest.mark.parametrize("camera", [0, 1])
def test_a_colour_of_one_camera_that_is_not_finite_leaves_its_gaussian_out(camera):
    gaussians, cameras = scene(dtype=torch.float32)
    features = torch.rand(2, 60, 3, generator=torch.Generator().manual_seed(0))
    rest = torch.arange(60) != 7
    expected, _, _ = call(gaussians[rest], cameras, colors=features[:, rest])
    features[camera, 7, 0] = torch.nan
    features.requires_grad_()
    renders, _, _ = call(gaussians, cameras, colors=features)
    assert torch.allclose(renders, expected, atol=1e-5)
    renders.sum().backward()
    assert features.grad.isfinite().all()


def test_opacities_of_each_camera_and_gradients_of_everything(exactly):
    dtype, bound = exactly
    gaussians, cameras = scene(1, dtype)
    own = torch.stack([gaussians.opacities, gaussians.opacities.flip(0)])
    gaussians, inputs = leaves(replace(gaussians, opacities=own))
    k = cameras.intrinsics[:, :3, :3].clone().requires_grad_()
    pose = cameras.extrinsics.clone().requires_grad_()
    renders, _, meta = rasterization(*inputs, pose, k, 32, 24, sh_degree=1, pixel_centers="integer")
    renders.square().sum().backward()
    again, expected = leaves(gaussians)
    image = GaussianRenderer()(again, kgs.pinhole_cameras(cameras.extrinsics, k.detach(), 32, 24)).image
    image.square().sum().backward()
    for got, wanted in zip(inputs, expected, strict=True):
        assert torch.allclose(got.grad, wanted.grad, atol=1e3 * bound * float(wanted.grad.abs().max().clamp_min(1)))
    assert k.grad.any()
    assert pose.grad.any()
    assert meta["means2d"].grad.shape == meta["means2d"].shape
    assert meta["means2d"].grad.any()


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rasterize_mode", "antialiased"),
        ("sparse_grad", True),
        ("absgrad", True),
        ("distributed", True),
        ("camera_model", "fisheye"),
        ("radius_clip", 0.5),
        ("far_plane", 100.0),
        ("covars", torch.eye(3).expand(60, 3, 3)),
        ("with_ut", True),
        ("global_z_order", False),
        ("return_normals", True),
        ("rays", torch.zeros(2, 24, 32, 6)),
        ("extra_signals", torch.zeros(60, 2)),
        ("rolling_shutter", RollingShutter.ROLLING_TOP_TO_BOTTOM),
        ("radial_coeffs", torch.zeros(2, 4)),
        ("render_mode", "RGBD"),
        ("pixel_centers", "corner"),
        ("sh_degree", 4),
        ("sh_degree", 0),
        ("colors", torch.zeros(59, 3).double()),
        ("colors", torch.zeros(3, 60, 3).double()),
        ("backgrounds", torch.zeros(2, 4).double()),
        ("near_plane", -1.0),
        ("tile_size", 0),
        ("backend", "cuda"),
    ],
)
def test_what_kgs_does_not_do_is_an_error_that_names_the_argument(name, value):
    gaussians, cameras = scene()
    named = "colors" if (name, value) == ("sh_degree", 0) else name
    with pytest.raises(ValueError, match=rf"^{named}: expected"):
        call(gaussians, cameras, **{name: value})


@pytest.mark.usefixtures("torch_alone")
def test_what_does_nothing_is_accepted_and_unknown_names_are_not():
    gaussians, cameras = scene()
    harmless = {"packed": False, "channel_chunk": 8, "segmented": True, "far_plane": 1e12, "radial_coeffs": None}
    assert torch.equal(call(gaussians, cameras, **harmless)[0], call(gaussians, cameras)[0])
    with pytest.raises(TypeError, match="unexpected argument 'near'"):
        call(gaussians, cameras, near=0.1)


def test_every_default_of_gsplat_may_be_given_by_name():
    gaussians, cameras = scene(dtype=torch.float32)
    given, alone = call(gaussians, cameras, **GSPLAT_DEFAULTS), call(gaussians, cameras)
    assert torch.equal(given[0], alone[0])


@pytest.mark.parametrize("mode", ["D", "ED"])
def test_depths_need_no_colours(mode):
    gaussians, cameras = scene(dtype=torch.float32)
    without = call(gaussians, cameras, colors=None, render_mode=mode)
    assert without[0].shape == (2, 24, 32, 1)
    assert torch.equal(without[0], call(gaussians, cameras, render_mode=mode)[0])


@pytest.mark.parametrize("mode", ["RGB", "RGB+D"])
def test_images_need_colours(mode):
    gaussians, cameras = scene(dtype=torch.float32)
    with pytest.raises(TypeError, match=r"^colors: expected a torch.Tensor, got NoneType"):
        call(gaussians, cameras, colors=None, render_mode=mode)


def test_radii_are_those_of_each_axis():
    gaussians, cameras = scene(dtype=torch.float32)
    radii, seen = call(gaussians, cameras)[2]["radii"], GaussianRenderer()(gaussians, cameras).projected
    covariances = seen.factors @ seen.factors.mT + seen.eps2d * torch.eye(2)
    assert radii.dtype == torch.int32
    assert torch.equal(radii, (3.33 * covariances.diagonal(dim1=1, dim2=2).sqrt()).ceil().int())


def small_gaussians_inside(n=200):
    """Parameters as gsplat's trainers have them, of Gaussians well inside the image, some large on the screen."""
    generator = torch.Generator().manual_seed(0)
    depths = 3 + torch.rand(n, generator=generator)
    places = (torch.rand(n, 2, generator=generator) - 0.5) * torch.tensor([0.4, 0.3]) * depths[:, None]
    values = {
        "means": torch.cat([places, depths[:, None]], 1),
        "scales": torch.log(0.02 + 0.1 * torch.rand(n, 3, generator=generator)),
        "quats": torch.randn(n, 4, generator=generator),
        "opacities": torch.randn(n, generator=generator),
        "colors": torch.rand(n, 3, generator=generator),
    }
    return {name: torch.nn.Parameter(value) for name, value in values.items()}


def test_gsplats_strategy_sees_what_it_sees_with_gsplats_projection(monkeypatch):
    """The state of DefaultStrategy and the number of Gaussians are those that gsplat's own torch projection gives."""
    pytest.importorskip("gsplat")
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
    from gsplat.strategy import DefaultStrategy

    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    size = (64, 48)
    k = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    pose = torch.eye(4)[None]
    target = torch.rand(1, 48, 64, 3, generator=torch.Generator().manual_seed(1))

    def fit(own_projection):
        torch.manual_seed(0)
        params = small_gaussians_inside()
        optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
        strategy = DefaultStrategy(
            refine_start_iter=10, refine_every=10, refine_scale2d_stop_iter=60, grow_grad2d=1e-5, grow_scale2d=0.12
        )
        state = strategy.initialize_state(scene_scale=1.0)
        counts = []
        for step in range(45):
            quats = torch.nn.functional.normalize(params["quats"], dim=1)
            shown = (params["means"], quats, params["scales"].exp(), params["opacities"].sigmoid(), params["colors"])
            renders, _, info = rasterization(*shown, pose, k, *size)
            if own_projection:
                covariances, _ = _quat_scale_to_covar_preci(quats, params["scales"].exp(), True, False, triu=False)
                radii = _fully_fused_projection(params["means"], covariances, pose, k, *size)[0]
                assert (radii > 0).all()
                info["radii"] = radii[0].index_select(0, info["gaussian_ids"])
            strategy.step_pre_backward(params, optimizers, state, step, info)
            (renders - target).square().mean().backward()
            strategy.step_post_backward(params, optimizers, state, step, info, packed=True)
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            counts.append(len(params["means"]))
        return counts, state

    (counts, state), (expected, wanted) = fit(False), fit(True)
    assert len(set(expected)) > 1  # it did split and duplicate
    assert counts == expected
    for name in ("grad2d", "count", "radii"):
        assert torch.equal(state[name], wanted[name])
