"""config.json of a fit: what is written is read, and what is wrong is named."""

import json
from pathlib import Path

import pytest
from refusals import refused

from kgs._support.errors import DataError
from kgs.app.saved_fit import read_settings
from kgs.app.scene_request import SceneRequest
from kgs.fit.config import DETAILS, FitConfig

REQUEST = SceneRequest("/photos", train_views=3, downscale=2.0, roll=-90.0, photos=False, title="mine")
VALUES = REQUEST.to_dict()


def written(path, request=VALUES, **fit):
    path.write_text(json.dumps({"request": request, "fit": FitConfig().to_dict() | fit, "extent": 1.0}))
    return path


@pytest.mark.parametrize(
    "config",
    [FitConfig(), FitConfig(**DETAILS["high"].entries), FitConfig(init="file", init_file=Path("/a.ply"))],
)
def test_what_was_written_comes_back(tmp_path, config):
    path = written(tmp_path / "config.json", **config.to_dict())
    assert read_settings(path) == (REQUEST, config)


def test_entries_that_older_files_lack_have_their_defaults(tmp_path):
    path = written(tmp_path / "config.json", {"scene": "/photos", "train_views": None, "unknown": 1})
    assert read_settings(path)[0] == SceneRequest("/photos")


WRONG = {"scene": ("", 3, "a\0b"), "train_views": (0, True), "downscale": (0.5, "2"), "hold_out": (1, -2, False)}
WRONG |= {"background": ("red",), "points": (["none"],), "photos": (1,), "roll": ("90",), "title": (None,)}


@pytest.mark.parametrize(
    ("request_", "field"),
    [(None, "request"), ({}, "request.scene")]
    + [(VALUES | {name: value}, f"request.{name}") for name, values in WRONG.items() for value in values],
)
def test_wrong_requests_are_named(tmp_path, request_, field):
    path = written(tmp_path / "config.json", request_)
    with refused(DataError, path=path, key=field):
        read_settings(path)


@pytest.mark.parametrize(
    ("fit", "key"),
    [({"steps": "2000"}, "steps"), ({"init_file": 3}, "init_file")]
    + [({name: value}, "values") for name, value in (("recipe", []), ("recipe", {"speed": 1.0}), ("stepz", 1))],
)
def test_wrong_numbers_of_the_fit_are_named(tmp_path, fit, key):
    path = written(tmp_path / "config.json", **fit)
    with refused(DataError, path=path, key=f"fit.{key}"):
        read_settings(path)
