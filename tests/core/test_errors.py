"""What the core refuses: the type of the error, and the name of the argument that its message begins with."""

import dataclasses
import math
import re

import pytest
import torch
from densifiers import SMALL
from densifiers import densifier as make
from factories import batch, drop_layer, posed, random_camera, random_gaussians, random_model
from kornia.sensors.camera import CameraModelType

import kgs
from kgs.camera import image_size
from kgs.densify import Densifier


def bad_options(name, *values):
    """The renderer's options are checked where they are made."""
    return [(name, ValueError, lambda value=value: kgs.RasterOptions(**{name: value})) for value in values]


def bad_densifier(name, *values):
    return [(name, ValueError, lambda value=value: make([SMALL], **{name: value})) for value in values]


def bad_layer(name, *values):
    return [(name, ValueError, lambda value=value: kgs.DropGaussian(**{name: value})) for value in values]


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


def camera(width=12, dtype=torch.float32):
    return random_camera(9, width, 0, dtype)


def camera_of_another_dtype():
    return posed(CameraModelType.PINHOLE, [9.0, 9.0, 6.0, 4.0], (24, 32), extrinsics=torch.eye(4)[None])


def with_two_rows_of_opacities():
    return dataclasses.replace(random_gaussians(3, 0, torch.float32), opacities=torch.full((2, 3), 0.5))


def drop_at(factor):
    drop_layer(0.5, p=0.2, schedule=lambda progress: factor)(torch.ones(5))


def densifier_with(optimizer):
    model = random_model(1)
    Densifier(model, getattr(torch.optim, optimizer)(model.parameters()), 1.0)


NAN, INF = math.nan, math.inf
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
    # the renderer
    *(bad_argument("outputs", ValueError, value) for value in (("imag",), (), "image")),
    *(bad_argument("background", ValueError, torch.zeros(shape)) for shape in ((4,), (2, 3), (1, 3, 12, 9))),
    bad_argument("background", TypeError, torch.zeros(3).double()),
    bad_argument("background", TypeError, (0, 0, 0)),
    bad_argument("cameras", TypeError, None),
    bad_argument("cameras", TypeError, lambda: camera(dtype=torch.float64)),
    bad_argument("cameras", TypeError, lambda: camera(dtype=torch.float16)),
    bad_argument("cameras", TypeError, camera_of_another_dtype),
    bad_argument("cameras", ValueError, lambda: batch(camera(12), camera(13))),
    bad_argument("gaussians", TypeError, None),
    ("opacities", ValueError, lambda: kgs.GaussianRenderer()(with_two_rows_of_opacities(), camera())),
    # cameras
    *[("cameras", TypeError, lambda wrong=wrong: image_size(wrong)) for wrong in (None, torch.eye(4))],
    ("cameras", TypeError, lambda: image_size(camera_of_another_dtype().model)),
    *[
        ("extrinsics", ValueError, lambda shape=shape: kgs.camera_extent(torch.zeros(shape)))
        for shape in ((4, 4), (0, 4, 4), (2, 3, 4))
    ],
    # the layer
    *bad_layer("schedule", "cosine", "", 3, None),
    *bad_layer("seed", 1.5, "a", True, 2**64, -(2**63) - 1, torch.tensor(1)),
    *[("p * schedule(progress)", ValueError, lambda factor=factor: drop_at(factor)) for factor in (-1.0, 5.0, NAN)],
    # the model
    bad_points("points", ValueError, torch.rand(3, 3), torch.rand(3, 3)),
    bad_points("points, colors", ValueError, torch.rand(5, 2), torch.rand(5, 2)),
    bad_points("points, colors", ValueError, torch.rand(5, 3), torch.rand(4, 3)),
    bad_points("points", ValueError, torch.ones(5, 3)),
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
    # densification
    *bad_densifier("extent", 0.0, -1.0, NAN, INF),
    *bad_densifier("percent_dense", 0.0, NAN),
    *bad_densifier("grad_threshold", -1.0, NAN),
    *bad_densifier("prune_opacity", -0.1, 1.1, NAN),
    *bad_densifier("max_gaussians", 0, 2.5, NAN, INF),
    *[("factor", ValueError, lambda x=x: make([SMALL])[2].decay_opacity(x)) for x in (0.0, 1.0, -0.5, NAN)],
    *[("ceiling", ValueError, lambda x=x: make([SMALL])[2].reset_opacity(x)) for x in (0.0, 1.0, NAN)],
    *[("optimizer", ValueError, lambda name=name: densifier_with(name)) for name in ("LBFGS", "Adafactor", "Rprop")],
]


@pytest.mark.parametrize(("name", "error", "call"), CASES, ids=[f"{i}-{case[0]}" for i, case in enumerate(CASES)])
def test_what_is_wrong_is_named(name, error, call):
    with pytest.raises(error, match=f"^{re.escape(name)}:"):
        call()
