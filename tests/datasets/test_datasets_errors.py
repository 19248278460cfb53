"""What the readers of scenes and the synthetic room refuse: the name of the argument."""

import numpy as np
import pytest
import torch
from factories import pinhole
from refusals import refused
from tiny_scenes import write_llff

from kgs import ArgumentError
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.images import Intrinsics, rectification
from kgs.datasets.scene import Views
from kgs.datasets.splits import select_evenly
from kgs.datasets.synthetic import synthetic_depths
from kgs.datasets.synthetic.raycast import raycast


def each(name, call, *values):
    """A case for each of these values."""
    return [(name, lambda root, value=value: call(root, value)) for value in values]


def of_scene(name, *values):
    def load(root, value):
        write_llff(root, 11)
        load_scene(root, **{name: value})

    return each(name, load, *values)


def of_room(name, value):
    return name, lambda _: synthetic_scene(**{name: value})


def distorted(_, first):
    rectification(Intrinsics(120, 90, 100, 98, 58, 47, (first, 0, 0, 0)))


def halved_row(_):
    Views(pinhole(1, 8, 30.0), torch.zeros(1, 3, 1, 8), ("a",), None).downsample(2)


def depths_of_two_sizes(_):
    cameras = pinhole(12, 16, 20.0, cameras=2)
    cameras.height[1] = 64.0
    synthetic_depths(cameras)


CASES = [
    *of_scene("background", "green"),
    *of_scene("points", "dense"),
    *of_scene("downscale", 0, 0.5, float("nan"), float("inf"), "2"),
    *of_scene("hold_out", 1, -1, 2.5, True, "3"),
    *of_scene("train_views", 0, 10, -1),
    *each("train_views", lambda _, views: select_evenly(17, views), 0, -1, 18, True, 2.0, "3"),
    of_room("train_views", 0),
    of_room("test_views", -1),
    of_room("size", (0, 8)),
    ("images", halved_row),
    ("cameras", depths_of_two_sizes),
    ("triangles", lambda _: raycast(np.zeros((3, 3)), np.eye(3), np.eye(4), (2, 2))),
    *each("distortion", distorted, -3.0, 40.0),
]


@pytest.mark.parametrize(("name", "call"), CASES)
def test_what_is_wrong_is_named(tmp_path, name, call):
    with refused(ArgumentError, name=name):
        call(tmp_path)
