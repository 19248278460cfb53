"""config.json of a fit: what is written is read, and what is wrong is named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from kgs.app.saved_fit import read_settings
from kgs.errors import DataError
from kgs.fit.config import DETAILS, FitConfig

REQUEST: dict[str, Any] = {"scene": "/photos", "train_views": 3, "downscale": 2.0, "background": "black"}


def written(path: Path, request: Any = REQUEST, **fit: Any) -> Path:
    path.write_text(json.dumps({"request": request, "fit": FitConfig().to_dict() | fit, "extent": 1.0}))
    return path


@pytest.mark.parametrize(
    "config",
    [FitConfig(), FitConfig(**DETAILS["high"].entries), FitConfig(init="file", init_file=Path("/a.ply"))],
)
def test_what_was_written_comes_back(tmp_path: Path, config: FitConfig) -> None:
    path = written(tmp_path / "config.json", **config.to_dict())
    assert read_settings(path) == (REQUEST | {"points": "none", "hold_out": None}, config)


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        (None, "request"),
        ({}, "request.scene"),
        (REQUEST | {"scene": ""}, "request.scene"),
        (REQUEST | {"scene": "a\0b"}, "request.scene"),
        (REQUEST | {"train_views": 0}, "request.train_views"),
        (REQUEST | {"train_views": True}, "request.train_views"),
        (REQUEST | {"downscale": 0.5}, "request.downscale"),
        (REQUEST | {"downscale": "2"}, "request.downscale"),
        (REQUEST | {"hold_out": 1}, "request.hold_out"),
        (REQUEST | {"hold_out": False}, "request.hold_out"),
        (REQUEST | {"background": "red"}, "request.background"),
        (REQUEST | {"points": ["none"]}, "request.points"),
    ],
)
def test_wrong_requests_are_named(tmp_path: Path, request_: Any, field: str) -> None:
    with pytest.raises(DataError, match=rf"config\.json.*{field}: expected"):
        read_settings(written(tmp_path / "config.json", request_))


@pytest.mark.parametrize(
    "fit",
    [
        {"steps": "2000"},
        {"steps": 2000.0},
        {"steps": True},
        {"steps": 10**9},
        {"drop": "0.2"},
        {"seed": 2**60},
        {"max_gaussians": 1.5},
        {"max_bytes": 0},
        {"init_points": 0},
        {"init_file": 3},
        {"recipe": []},
        {"recipe": {"lr_means": None}},
        {"recipe": {"densify_interval": 0}},
        {"recipe": {"speed": 1.0}},
        {"stepz": 1},
    ],
)
def test_wrong_numbers_of_the_fit_are_named(tmp_path: Path, fit: dict[str, Any]) -> None:
    with pytest.raises(DataError, match=r"config\.json.*fit"):
        read_settings(written(tmp_path / "config.json", **fit))
