"""What the core and its stages refuse: the type of the error, and the name that its message begins with."""

import copy
import dataclasses
import functools
import math
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from densifiers import SMALL, seen
from densifiers import densifier as make
from factories import (
    FIELDS,
    batch,
    drop_layer,
    footprints,
    pinhole,
    posed,
    random_camera,
    random_gaussians,
    random_model,
)
from factories import replace as with_fields
from kornia.geometry.camera import PinholeCamera
from kornia.sensors.camera import CameraModelType

import kgs
import kgs.reference
from kgs._support.errors import ArgumentError, DataError, PhotosRefused, cause_of, quoted
from kgs.compressed_ply import save_compressed_ply
from kgs.densify import Densifier
from kgs.geometry.cameras import image_size
from kgs.losses import photometric_loss, target_moments
from kgs.ply import load_ply, save_ply


def each(name, error, call, *values):
    """A case for each of these values."""
    return [(name, error, functools.partial(call, value)) for value in values]


def bad_options(name, *values):
    """The renderer's options are checked where they are made."""
    return each(name, ValueError, lambda value: kgs.RasterOptions(**{name: value}), *values)


def bad_densifier(name, *values):
    return each(name, ValueError, lambda value: make([SMALL], **{name: value}), *values)


def bad_layer(name, *values):
    return each(name, ValueError, lambda value: kgs.DropGaussian(**{name: value}), *values)


def bad_points(name, error, points, colors=None):
    return name, error, lambda: kgs.GaussianModel.from_points(points, torch.rand(5, 3) if colors is None else colors)


def bad_parameter(name, error, value):
    return name, error, lambda: kgs.GaussianModel(**(random_model(7).state_dict() | {name: value}))


def bad_argument(name, error, value):
    """Of the renderer."""

    def call():
        arguments = {"gaussians": random_gaussians(3, 0, torch.float32), "cameras": camera()}
        kgs.GaussianRenderer()(**(arguments | {name: value() if callable(value) else value}))

    return name, error, call


def bad_call_of_gsplat(name, dtype):
    """A tensor of another dtype, or None."""

    def call():
        gaussians, seen = random_gaussians(3, 0, torch.float32, None), camera()
        given = vars(gaussians) | {"viewmats": seen.extrinsics, "Ks": seen.intrinsics[:, :3, :3]}
        tensors = given | {"covars": torch.eye(3).expand(3, 3, 3)}
        wrong = None if dtype is None else tensors[name].to(dtype)
        kgs.rasterization(**given | {name: wrong}, width=12, height=9)

    return name, TypeError, call


def bad_matrices(name, error, value):
    """Of `pinhole_cameras`."""

    def call():
        given = {"viewmats": torch.eye(4), "Ks": torch.eye(3), "width": 32, "height": 24, name: value}
        kgs.pinhole_cameras(**given)

    return name, error, call


def bad_stage(name, error, features=None, **changes):
    """Of compositing."""

    def call():
        layers = footprints(torch.zeros(2, 2), torch.zeros(2, 2, 3), torch.full((2,), 0.5), (3, 4))
        fields = {key: value for key, value in changes.items() if hasattr(layers, key)}
        options = {key: value for key, value in changes.items() if key not in fields}
        given = dataclasses.replace(layers, **fields)
        kgs.composite(given, torch.zeros(2, 3) if features is None else features, **options)

    return name, error, call


def bad_loss(name, error, image=None, target=None, **options):
    def call():
        right = torch.full((2, 3, 16, 19), 0.5)
        photometric_loss(right if image is None else image, right if target is None else target, **options)

    return name, error, call


def camera(width=12, dtype=torch.float32):
    return random_camera(9, width, 0, dtype)


def camera_with_intrinsics_of_another_dtype():
    seen = camera()
    return PinholeCamera(seen.intrinsics.double(), seen.extrinsics, seen.height, seen.width)


def camera_of_another_dtype():
    return posed(CameraModelType.PINHOLE, [9.0, 9.0, 6.0, 4.0], (24, 32), extrinsics=torch.eye(4)[None])


def camera_with_extrinsics(shape):
    posed(CameraModelType.PINHOLE, extrinsics=torch.zeros(shape))


def saved_with_degree(degree):
    save_ply("no.ply", random_model(sh_degree=1), sh_degree=degree)


def drawn_with_rows_of_opacities(rows, cameras):
    gaussians = dataclasses.replace(random_gaussians(3, 0, torch.float32), opacities=torch.full((rows, 3), 0.5))
    kgs.GaussianRenderer()(gaussians, batch(*[camera()] * cameras))


def drop_at(factor):
    drop_layer(0.5, p=0.2, schedule=lambda progress: factor)(torch.ones(5))


def drop_by_later_rates(rates):
    layer = drop_layer(1.0)
    layer.p = rates
    layer(torch.ones(2))


def drawn_by_the_reference(seen=None, background=None, **changes):
    gaussians = with_fields(random_gaussians(3, 0, torch.float32), **changes)
    return kgs.reference.render(gaussians, camera() if seen is None else seen, background)


def observe(scales, grad=(1, 0), needs_one=True, **options):
    """A render of one Gaussian, by the densifier of some."""
    projected = seen(make([SMALL])[0], [0], [grad or (0, 0)])
    if grad is None:
        projected.means2d.grad = None
    projected.means2d.requires_grad_(needs_one)
    make(scales, **options)[2].observe(projected)


def state_of_another_size():
    make([SMALL] * 2)[2].load_state_dict(make([SMALL] * 3)[2].state_dict())


def optimizer_of_the_means_alone():
    model = random_model(1)
    Densifier(model, torch.optim.Adam([model.means]), 1.0)


def densifier_with(optimizer):
    model = random_model(1)
    Densifier(model, getattr(torch.optim, optimizer)(model.parameters()), 1.0)


NAN = math.nan
INF = math.inf
BAD_RATES = [torch.tensor(rates) for rates in ([0.5, 1.0], [-0.1, 0.5], [0.5, NAN])]
BAD_VECTORS = [torch.zeros(1, 3), torch.tensor([0.0, NAN, 0.0])]
CASES = [
    # options
    *bad_options("tile_size", 0, 8.0, 8.5, True),
    *bad_options("max_bytes", 0, -1),
    *bad_options("near_plane", NAN, -1.0),
    *bad_options("far_plane", 0.01, NAN, "far"),
    *bad_options("eps2d", -1.0, INF),
    *bad_options("radius_clip", -1, INF),
    *bad_options("antialiased", 1),
    *bad_options("absgrad", 1, None, "yes"),
    *bad_options("alpha_threshold", -0.1, 1.0, NAN),
    *bad_options("transmittance_stop", -1e-9, 1.0, "0"),
    *bad_options("frame", (0, 0, 4), (4.0, 0.0, 4.0, 8.0), (0.0, 0.0, INF, 8.0)),
    ("near_plane", ValueError, lambda: kgs.GaussianRenderer(near_plane=-1.0)),
    ("options", TypeError, lambda: kgs.GaussianRenderer(options=kgs.RasterOptions(), eps2d=0.1)),
    ("options", TypeError, lambda: kgs.GaussianRenderer(options={"eps2d": 0.1})),
    ("last_plane", TypeError, lambda: kgs.GaussianRenderer(last_plane=10.0)),
    ("options", TypeError, lambda: kgs.project(random_gaussians(3, 0), camera(), options={"eps2d": 0.1})),
    bad_stage("options", TypeError, options={"eps2d": 0.1}),
    # the renderer
    ("opacity_layer", TypeError, lambda: kgs.GaussianRenderer(opacity_layer=0.2)),
    *(bad_argument("outputs", ValueError, value) for value in (("imag",), (), "image")),
    *(bad_argument("background", ValueError, torch.zeros(shape)) for shape in ((4,), (2, 3), (1, 3, 12, 9))),
    bad_argument("background", TypeError, torch.zeros(3).double()),
    bad_argument("background", TypeError, (0, 0, 0)),
    bad_argument("cameras", TypeError, None),
    bad_argument("cameras", TypeError, lambda: camera(dtype=torch.float64)),
    bad_argument("cameras", TypeError, lambda: camera(dtype=torch.float16)),
    bad_argument("cameras", TypeError, camera_of_another_dtype),
    bad_argument("cameras", ValueError, lambda: batch(camera(12), camera(13))),
    bad_argument("cameras", TypeError, camera_with_intrinsics_of_another_dtype),
    bad_argument("cameras", TypeError, lambda: camera().extrinsics),
    ("cameras", TypeError, lambda: kgs.project(random_gaussians(3, 0, torch.float32).to("meta"), camera())),
    bad_argument("gaussians", TypeError, None),
    ("gaussians", TypeError, lambda: kgs.project([random_gaussians(3, 0)], camera())),
    bad_argument("gaussians", TypeError, lambda: random_model(3)),
    *each("opacities", ValueError, lambda shape: drawn_with_rows_of_opacities(*shape), (2, 1), (1, 3), (2, 3)),
    # cameras
    *each("cameras", TypeError, image_size, None, torch.eye(4)),
    ("cameras", TypeError, lambda: image_size(camera_of_another_dtype().model)),
    ("cameras", ValueError, lambda: image_size(batch(pinhole(4, 6, 9.0), pinhole(5, 6, 9.0)))),
    ("cameras", ValueError, lambda: image_size(pinhole(0, 64, 9.0))),
    *each("extrinsics", ValueError, lambda shape: kgs.camera_extent(torch.zeros(shape)), (4, 4), (0, 4, 4), (2, 3, 4)),
    *each("model", TypeError, lambda wrong: kgs.PosedCamera(wrong, torch.eye(4)[None]), camera(), None),
    ("extrinsics", TypeError, lambda: posed(CameraModelType.PINHOLE, extrinsics=torch.eye(4)[None].tolist())),
    *each("extrinsics", ValueError, camera_with_extrinsics, (4, 4), (1, 3, 4), (1, 1, 4, 4)),
    ("model", ValueError, lambda: posed(CameraModelType.PINHOLE, torch.ones(2, 4).double(), cameras=3)),
    bad_matrices("viewmats", TypeError, [1]),
    bad_matrices("viewmats", ValueError, torch.eye(3)),
    bad_matrices("Ks", TypeError, torch.eye(3).double()),
    *[bad_matrices("Ks", ValueError, value) for value in (torch.eye(2), torch.eye(3).repeat(2, 1, 1))],
    bad_matrices("width", ValueError, 0),
    bad_matrices("height", ValueError, 2.5),
    bad_matrices("pixel_centers", ValueError, "centre"),
    ("extrinsics", ValueError, lambda: camera_with_extrinsics((0, 4, 4))),
    # gsplat's call
    *[bad_call_of_gsplat(name, None) for name in (*FIELDS, "viewmats", "Ks")],
    *[
        bad_call_of_gsplat(name, dtype)
        for name in (*FIELDS[1:], "viewmats", "Ks", "covars")
        for dtype in (torch.float64, torch.float16, torch.int64)
    ],
    # compositing
    *[bad_stage("features", ValueError, torch.zeros(shape)) for shape in ((0, 3), (1, 3), (4, 3), (30, 3), (2,))],
    bad_stage("features", TypeError, [1.0]),
    bad_stage("features", TypeError, torch.zeros(2, 3).double()),
    bad_stage("opacities", TypeError, opacities=torch.ones(2).double()),
    bad_stage("factors", TypeError, factors=torch.zeros(2, 2, 3).double()),
    *[bad_stage("camera_ids", ValueError, camera_ids=torch.tensor(ids)) for ids in ([0, 1], [-1, 0], [0, 2**40])],
    bad_stage("means2d", ValueError, means2d=torch.zeros(2, 3)),
    bad_stage("factors", ValueError, factors=torch.zeros(2, 3, 2)),
    bad_stage("depths", ValueError, depths=torch.zeros(1)),
    bad_stage("max_bytes", ValueError, options=kgs.RasterOptions(max_bytes=160)),
    bad_stage("chunk_size", ValueError, chunk_size=0),
    bad_stage("backend", ValueError, backend="cuda"),
    ("projected", TypeError, lambda: kgs.composite([1.0], torch.zeros(2, 3))),
    # the reference
    ("camera", TypeError, lambda: drawn_by_the_reference("camera")),
    ("camera", ValueError, lambda: drawn_by_the_reference(batch(camera(), camera()))),
    ("camera", ValueError, lambda: drawn_by_the_reference(opacities=torch.ones(2, 3))),
    ("background", ValueError, lambda: drawn_by_the_reference(background=torch.zeros(2, 3))),
    # the loss
    bad_loss("image", TypeError, torch.zeros(2, 3, 16, 19).numpy()),
    bad_loss("image", TypeError, torch.zeros(2, 3, 16, 19).half(), torch.zeros(2, 3, 16, 19).half()),
    bad_loss("target", TypeError, target=torch.zeros(2, 3, 16, 19).double()),
    bad_loss("target", ValueError, target=torch.zeros(2, 3, 16, 18)),
    *[bad_loss("image", ValueError, torch.zeros(shape), torch.zeros(shape)) for shape in ((3, 16, 19), (2, 3, 16, 5))],
    *[bad_loss("dssim_weight", ValueError, dssim_weight=weight) for weight in (-0.1, NAN, INF)],
    bad_loss("moments", ValueError, moments=target_moments(torch.zeros(2, 3, 16, 18))),
    *[bad_loss("mask", ValueError, mask=torch.ones(shape)) for shape in ((19, 16), (3, 1, 16, 19), (2, 3, 16, 19), ())],
    *[bad_loss("mask", ValueError, mask=torch.full((16, 19), value)) for value in (0.0, 0.5, 2.0, NAN)],
    bad_loss("mask", ValueError, mask=[1]),
    ("target", ValueError, lambda: target_moments(torch.zeros(2, 3, 16, 5))),
    # the layer
    *bad_layer("p", -0.1, 1, 1.0, 1.5, INF, -INF, NAN, "0.2", None),
    *bad_layer("p", *BAD_RATES),
    *each("p", ValueError, lambda rate: kgs.drop_gaussian(torch.ones(2), rate), 1.0, *BAD_RATES),
    *each("p", ValueError, lambda rate: kgs.drop_gaussian(torch.ones(2), rate, training=False), 1.0, *BAD_RATES),
    *each("p * schedule(progress)", ValueError, drop_by_later_rates, *BAD_RATES),
    *[
        ("p", ValueError, lambda shape=shape, n=n: kgs.drop_gaussian(torch.ones(shape), torch.full((n,), 0.5)))
        for shape, n in (((5,), 4), ((3, 5), 3), ((5, 1), 4), ((), 4), ((5, 4, 1), 5))
    ],
    *each(
        "schedule",
        ValueError,
        drop_at,
        torch.ones(4),
        torch.ones(0),
        torch.ones(2, 2),
        np.ones(4),
        np.ones(0),
        np.ones((2, 2)),
    ),
    *[
        ("opacities", TypeError, lambda seed=seed, wrong=wrong: drop_layer(1.0, p=0.5, seed=seed)(wrong))
        for seed in (None, 3)
        for wrong in (torch.ones(3, dtype=torch.int64), [0.5, 0.5])
    ],
    ("seed", ValueError, lambda: kgs.DropGaussian().get_rng_state()),
    ("seed", ValueError, lambda: kgs.DropGaussian().set_rng_state(torch.get_rng_state())),
    *bad_layer("schedule", "cosine", "", 3, None),
    *bad_layer("seed", 1.5, "a", True, 2**64, -(2**63) - 1, torch.tensor(1)),
    *each("p * schedule(progress)", ValueError, drop_at, -1.0, 5.0, NAN),
    # the model
    bad_points("points", ValueError, torch.rand(3, 3), torch.rand(3, 3)),
    bad_points("points, colors", ValueError, torch.rand(5, 2), torch.rand(5, 2)),
    bad_points("points, colors", ValueError, torch.rand(5, 3), torch.rand(4, 3)),
    bad_points("points", ValueError, torch.ones(5, 3)),
    bad_points("points", ValueError, torch.zeros(5, 3)),
    bad_points(
        "points", ValueError, 1e308 * torch.tensor([[10.0], [-10.0], [1.0], [-1.0], [5.0]]).double().expand(5, 3)
    ),
    bad_points("points", ValueError, torch.full((5, 3), NAN)),
    bad_points("colors", ValueError, torch.rand(5, 3), torch.full((5, 3), NAN)),
    bad_points("points", TypeError, torch.rand(5, 3).half()),
    bad_points("points", TypeError, [[0.0, 0.0, 0.0]]),
    bad_points("colors", TypeError, torch.rand(5, 3), [[0.0, 0.0, 0.0]]),
    bad_points("colors", TypeError, torch.rand(5, 3), torch.zeros(5, 3, dtype=torch.uint8)),
    bad_parameter("means", ValueError, torch.zeros(7, 2)),
    bad_parameter("quats", ValueError, torch.zeros(7, 3)),
    bad_parameter("opacity_logits", ValueError, torch.zeros(7, 1)),
    bad_parameter("sh_rest", ValueError, torch.zeros(7, 4, 3)),
    bad_parameter("sh_dc", ValueError, torch.zeros(7, 3)),
    bad_parameter("log_scales", TypeError, torch.zeros(7, 3).double()),
    bad_parameter("means", TypeError, torch.zeros(7, 3).half()),
    bad_parameter("means", TypeError, [[0.0, 0.0, 0.0]]),
    bad_parameter("quats", TypeError, None),
    *each("sh_degree", ValueError, lambda degree: setattr(random_model(), "sh_degree", degree), -1, 4, 1.0, "2"),
    ("sh_degree", ValueError, lambda: kgs.GaussianModel.from_points(torch.rand(5, 3), torch.rand(5, 3), sh_degree=4)),
    # its file
    *each("sh_degree", ValueError, saved_with_degree, 0, 4, -1, 3.0),
    *each("offset", ValueError, lambda wrong: save_ply("no.ply", random_model(), wrong), *BAD_VECTORS),
    ("model", TypeError, lambda: save_ply("no.ply", random_model()())),
    ("model", TypeError, lambda: save_compressed_ply("no.ply", random_model()())),
    ("model", ValueError, lambda: save_compressed_ply("no.ply", random_model(0))),
    ("offset", ValueError, lambda: save_compressed_ply("no.ply", random_model(), torch.zeros(2))),
    *each("origin", ValueError, lambda wrong: load_ply("no.ply", wrong), *BAD_VECTORS),
    # densification
    *bad_densifier("extent", 0.0, -1.0, NAN, INF),
    *bad_densifier("percent_dense", 0.0, NAN),
    *bad_densifier("grad_threshold", -1.0, NAN),
    *bad_densifier("prune_opacity", -0.1, 1.1, NAN),
    *bad_densifier("max_gaussians", 0, 2.5, NAN, INF),
    *each("factor", ValueError, lambda x: make([SMALL])[2].decay_opacity(x), 0.0, 1.0, -0.5, NAN),
    *each("ceiling", ValueError, lambda x: make([SMALL])[2].reset_opacity(x), 0.0, 1.0, NAN),
    ("projected", ValueError, lambda: observe([SMALL] * 2)),
    ("projected", ValueError, lambda: observe([SMALL], absgrad=True)),
    ("projected", ValueError, lambda: observe([SMALL], grad=None)),
    ("projected", ValueError, lambda: observe([SMALL], grad=None, needs_one=False)),
    ("gradient_sums", ValueError, state_of_another_size),
    ("state", ValueError, lambda: make([SMALL])[2].load_state_dict({})),
    ("optimizer", ValueError, optimizer_of_the_means_alone),
    *each("optimizer", ValueError, densifier_with, "LBFGS", "Adafactor", "Rprop"),
]


@pytest.mark.parametrize(("name", "error", "call"), CASES, ids=[f"{i}-{case[0]}" for i, case in enumerate(CASES)])
def test_what_is_wrong_is_named(name, error, call):
    with pytest.raises(error) as caught:
        call()
    assert getattr(caught.value, "name", str(caught.value).partition(":")[0]) == name


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ArgumentError("steps", "at least 1", 0), "steps: expected at least 1, got 0"),
        (ArgumentError("steps", "at least 1", quoted("0")), "steps: expected at least 1, got '0'"),
        (ArgumentError("drop", "less than 1", quoted(1.0)), "drop: expected less than 1, got 1.0"),
        (ArgumentError("file", "a path", None), "file: expected a path, got None"),
        (ArgumentError("mask", "True and False"), "mask: expected True and False"),
        (ArgumentError("x", "one", "none", advice="take\ntwo"), "x: expected one, got none: take\ntwo"),
        (ArgumentError("x", "one", [7] * 99), f"x: expected one, got [{'7, ' * 18}7,..."),
        (ArgumentError("x", "one", torch.eye(2)), "x: expected one, got tensor([[1., 0.], [0., 1.]])"),
        (ArgumentError("x", "one", quoted("\n" * 99)), "x: expected one, got '" + "\\n" * 28 + "..."),
        (DataError("a.json", "fit", "an object", None), "a.json: fit: expected an object, got None"),
        (DataError(Path("a\nb"), "", "a file", "c\x1b"), "a\\nb: expected a file, got c\\x1b"),
        (PhotosRefused("a", "", "photos", "a panorama", advice="cut it"), "a: expected photos, got a panorama: cut it"),
    ],
)
def test_an_error_makes_its_sentence_and_goes_whole_to_other_processes(error, said):
    for same in (error, copy.copy(error), pickle.loads(pickle.dumps(error))):
        assert type(same) is type(error)
        assert vars(same) == vars(error)
        assert str(same) == said


def test_an_argument_becomes_an_entry_of_a_file():
    error = ArgumentError("fit", "an object", 3, advice="fit again")
    assert str(error.about("a.json")) == "a.json: fit: expected an object, got 3: fit again"
    assert str(error.about("a.json", "")) == "a.json: expected an object, got 3: fit again"


def test_the_first_cause_of_an_error_is_a_line():
    first = OSError("no\n  compiler\x1b\n")
    for error in (RuntimeError("at 3:4:\n    x = y\n"), ValueError("")):
        error.__cause__ = first
        first = error
    assert cause_of(first) == "OSError: no compiler\\x1b"
    long = cause_of(RuntimeError(f"at 3:4:\n{'x = y' * 1000}\nunknown name y"))
    assert re.fullmatch(r"RuntimeError: at 3:4: .* \.\.\. .*unknown name y", long)
    assert len(long) < 400
