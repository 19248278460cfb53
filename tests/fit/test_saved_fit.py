"""config.json of a fit: what is written is read, and what is wrong is named."""

import json

import pytest
from refusals import refused

from kgs._support.errors import DataError
from kgs.app.saved_fit import read_request
from kgs.app.scene_request import SceneRequest

REQUEST = SceneRequest("/photos", train_views=3, downscale=2.0, roll=-90.0, photos=False, title="mine")
VALUES = REQUEST.to_dict()


def written(path, request=VALUES):
    path.write_text(json.dumps({"request": request, "extent": 1.0}))
    return path


def test_what_was_written_comes_back(tmp_path):
    assert read_request(written(tmp_path / "config.json")) == REQUEST


def test_entries_that_older_files_lack_have_their_defaults(tmp_path):
    path = written(tmp_path / "config.json", {"scene": "/photos", "train_views": None, "unknown": 1})
    assert read_request(path) == SceneRequest("/photos")


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
        read_request(path)
