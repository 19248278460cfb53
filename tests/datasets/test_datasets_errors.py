"""What the readers of scenes and the synthetic room refuse: the name of the argument."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from factories import pinhole
from kornia.geometry.camera import PinholeCamera
from refusals import refused
from tiny_scenes import write_llff

from kgs import ArgumentError
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.images import Intrinsics, rectification
from kgs.datasets.scene import Views
from kgs.datasets.splits import select_evenly
from kgs.datasets.synthetic import synthetic_depths
from kgs.datasets.synthetic.raycast import raycast

LOADED = {
    "background": ("green",),
    "points": ("dense",),
    "downscale": (0, 0.5, float("nan"), float("inf"), "2"),
    "hold_out": (1, -1, 2.5, True, "3"),
    "train_views": (0, 10, -1),
}
OF_ROOM = {"train_views": 0, "test_views": -1, "size": (0, 8)}


def loaded(root: Path, name: str, value: object) -> None:
    write_llff(root, 11)
    arguments: dict[str, Any] = {name: value}
    load_scene(root, **arguments)


def of_one_row() -> Views:
    cameras = pinhole(1, 8, 30.0, dtype=torch.float32)
    return Views(cameras, torch.zeros(1, 3, 1, 8), ("a",), torch.ones(1, 1, 1, 8))


def cameras_of_two_sizes() -> PinholeCamera:
    cameras = pinhole(12, 16, 20.0, dtype=torch.float32, cameras=2)
    cameras.height = torch.tensor([12.0, 13.0])
    return cameras


def room(**arguments: Any) -> None:
    synthetic_scene(**arguments)


CASES: list[tuple[str, Callable[[Path], object]]] = [
    *[
        (name, lambda root, name=name, value=value: loaded(root, name, value))
        for name, values in LOADED.items()
        for value in values
    ],
    *[("train_views", lambda _, views=views: select_evenly(17, views)) for views in (0, -1, 18, True, 2.0, "3")],
    *[(name, lambda _, name=name, value=value: room(**{name: value})) for name, value in OF_ROOM.items()],
    ("images", lambda _: of_one_row().downsample(2)),
    ("cameras", lambda _: synthetic_depths(cameras_of_two_sizes())),
    ("triangles", lambda _: raycast(np.zeros((3, 3)), np.eye(3), np.eye(4), (2, 2))),
    *[
        ("distortion", lambda _, first=first: rectification(Intrinsics(120, 90, 100, 98, 58, 47, (first, 0, 0, 0))))
        for first in (-3.0, 40.0)
    ],
]


@pytest.mark.parametrize(("name", "call"), CASES)
def test_what_is_wrong_is_named(tmp_path: Path, name: str, call: Callable[[Path], object]) -> None:
    with refused(ArgumentError, name=name):
        call(tmp_path)
