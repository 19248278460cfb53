"""gsplat's call: against the renderer and the dense reference, and what it refuses."""

import enum
import inspect
import weakref

import pytest
import torch
from factories import FIELDS, batch, leaves, random_camera, random_gaussians
from refusals import refused

from kgs import ArgumentError, GaussianRenderer, rasterization

pytestmark = pytest.mark.usefixtures("each_backend")

SIZE = (24, 32)
REQUIRED = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"]


class RollingShutter(enum.Enum):
    """As gsplat's."""

    ROLLING_TOP_TO_BOTTOM = 0
    GLOBAL = 4


GSPLAT_DEFAULTS = {  # of 1.6, in its order
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
    return rasterization(**{"viewmats": cameras.extrinsics, "Ks": k} | arguments, width=32, height=24, **centers)


@pytest.mark.usefixtures("torch_alone")
def test_the_names_and_their_order_are_gsplats():
    parameters = inspect.signature(rasterization).parameters
    names = [name for name, value in parameters.items() if value.kind is value.POSITIONAL_OR_KEYWORD]
    assert names == [*REQUIRED, *GSPLAT_DEFAULTS]
    for name, value in GSPLAT_DEFAULTS.items():
        assert parameters[name].default == (None if name == "rolling_shutter" else value)


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


REFUSED = {
    "rasterize_mode": ["sharp"],
    "sparse_grad": [True],
    "distributed": [True],
    "camera_model": ["ftheta"],
    "radius_clip": [-0.5],
    "far_plane": [0.001, float("nan")],
    "covars": [torch.eye(3).double().expand(59, 3, 3)],
    "with_ut": [True],
    "with_eval3d": [True],
    "global_z_order": [False],
    "rays": [torch.zeros(2, 24, 32, 6)],
    "extra_signals": [torch.zeros(60, 2).double()],
    "return_normals": [True],
    "extra_signals_sh_degree": [3],
    "viewmats_rs": [torch.eye(4).expand(2, 4, 4)],
    "rolling_shutter": [RollingShutter.ROLLING_TOP_TO_BOTTOM],
    "radial_coeffs": [torch.zeros(2, 4)],
    "render_mode": ["RGBD", "RGB-Ed"],
    "pixel_centers": ["corner"],
    "sh_degree": [4, 0],
    "colors": [torch.zeros(59, 3).double(), torch.zeros(3, 60, 3).double()],
    "backgrounds": [torch.zeros(2, 4).double()],
    "means": [torch.zeros(2, 60, 3).double(), torch.zeros(60, 2).double(), torch.tensor(1.0).double()],
    "viewmats": [
        torch.eye(4).double(),
        torch.eye(4).double().expand(0, 4, 4),
        torch.eye(4).double().expand(1, 2, 4, 4),
    ],
    "Ks": [torch.eye(3).double()],
    "scales": [torch.zeros(60).double()],
    "near_plane": [-1.0],
    "tile_size": [0],
    "backend": ["cuda"],
}


@pytest.mark.usefixtures("torch_alone")
@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in REFUSED.items() for value in values])
def test_what_kgs_does_not_do_is_an_error_that_names_the_argument(name, value):
    gaussians, cameras = scene()
    named = "colors" if (name, value) == ("sh_degree", 0) else name
    with refused(ArgumentError, name=named):
        call(gaussians, cameras, **{name: value})


@pytest.mark.usefixtures("torch_alone")
def test_harmonics_through_an_orthographic_lens_are_refused():
    """gsplat takes their directions from the camera's centre, kgs along the rays."""
    with refused(ArgumentError, name="sh_degree"):
        call(*scene(sh_degree=1), sh_degree=1, camera_model="ortho")


@pytest.mark.usefixtures("torch_alone")
def test_what_does_nothing_is_accepted_and_unknown_names_are_not():
    gaussians, cameras = scene()
    harmless = {"packed": False, "channel_chunk": 8, "segmented": True, "far_plane": 1e12, "macro_tile": True}
    assert torch.equal(call(gaussians, cameras, **harmless)[0], call(gaussians, cameras)[0])
    with pytest.raises(TypeError, match="unexpected keyword argument 'near'"):
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


def test_radii_are_those_of_each_axis():
    gaussians, cameras = scene(dtype=torch.float32)
    radii, seen = call(gaussians, cameras)[2]["radii"], GaussianRenderer()(gaussians, cameras).projected
    covariances = seen.factors @ seen.factors.mT + seen.eps2d * torch.eye(2)
    assert radii.dtype == torch.int32
    assert torch.equal(radii, (3.33 * covariances.diagonal(dim1=1, dim2=2).sqrt()).ceil().int())


# -- what gsplat's call has beyond the renderer's --------------------------------------------------------------------


def test_the_dense_layout_says_what_the_packed_one_does():
    gaussians, cameras = scene(dtype=torch.float32)
    found = []
    for packed in (True, False):
        leaf, inputs = leaves(gaussians)
        renders, alphas, meta = call(leaf, cameras, packed=packed, absgrad=True)
        meta["means2d"].retain_grad()
        renders.square().sum().backward()
        found.append((renders, alphas, meta, inputs))
    (renders, alphas, packed, inputs), (again, alphas_again, dense, inputs_again) = found
    assert torch.equal(renders, again)
    assert torch.equal(alphas, alphas_again)
    for one, other in zip(inputs, inputs_again, strict=True):
        assert torch.equal(one.grad, other.grad)
    seen = (packed["camera_ids"], packed["gaussian_ids"])
    assert not packed["batch_ids"].any()
    assert [dense[name] for name in ("batch_ids", "camera_ids", "gaussian_ids")] == [None] * 3
    dense |= {"grad": dense["means2d"].grad, "absgrad": dense["means2d"].absgrad}
    packed |= {"grad": packed["means2d"].grad, "absgrad": packed["means2d"].absgrad}
    for name in ("means2d", "radii", "depths", "conics", "opacities", "grad", "absgrad"):
        assert dense[name].shape == (2, 60, *packed[name].shape[1:])
        assert torch.equal(dense[name][seen], packed[name])
        rest = dense[name].detach().clone()
        rest[seen] = 0
        assert not rest.any()
    assert packed["absgrad"].sum() > 1.1 * packed["grad"].abs().sum()


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("sh_degree", [None, 1])
def test_no_gaussians_and_none_seen(packed, sh_degree):
    cameras = batch(*(random_camera(*SIZE, seed, torch.float32) for seed in range(2)))
    views = (cameras.extrinsics, cameras.intrinsics[:, :3, :3])
    for n in (0, 4):  # the four lie behind the cameras
        values = [torch.rand(n, width) for width in (3, 4, 3)]
        values[0][..., 2] -= 9.0
        values += [torch.rand(n), torch.rand(n, *((3,) if sh_degree is None else (4, 3)))]
        leaves = [x.requires_grad_() for x in values]
        options = {"sh_degree": sh_degree, "packed": packed, "absgrad": True, "render_mode": "RGB+ED"}
        renders, alphas, meta = rasterization(*leaves, *views, 32, 24, **options)
        assert renders.shape == (2, 24, 32, 4)
        assert not renders.any()
        assert not alphas.any()
        assert meta["means2d"].shape == ((0, 2) if packed else (2, n, 2))
        if n:
            renders.sum().backward()
            assert not any(x.grad is not None and x.grad.any() for x in leaves)


@pytest.mark.parametrize("shape", [(60, 0), (2, 60, 0)])
def test_features_of_no_width(shape):
    gaussians, cameras = scene(dtype=torch.float32)
    renders, _, _ = call(gaussians, cameras, colors=torch.zeros(shape), render_mode="RGB+D")
    assert renders.shape == (2, 24, 32, 1)


@pytest.mark.parametrize("packed", [True, False])
def test_a_second_backward_pass_sets_the_same_absolute_gradients(packed):
    gaussians, cameras = scene(dtype=torch.float32)
    renders, _, meta = call(leaves(gaussians)[0], cameras, absgrad=True, packed=packed)
    renders.square().sum().backward(retain_graph=True)
    first = meta["means2d"].absgrad.clone()
    renders.square().sum().backward()
    assert torch.equal(meta["means2d"].absgrad, first)


@pytest.mark.usefixtures("torch_alone")
def test_a_render_keeps_no_more_than_it_needs():
    """Without absolute gradients nothing of the call is alive after the backward pass but what meta holds."""
    gaussians, cameras = scene(dtype=torch.float32)
    renders, _, meta = call(leaves(gaussians)[0], cameras)
    loss = renders.square().sum()
    reference = weakref.ref(meta["means2d"])
    loss.backward()
    del renders, meta
    assert reference() is None
    assert loss > 0
