"""Fits and cameras that several files look at: each is made once."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import pytest
from command import run
from photo_folders import small_planes, write_planes

from kgs.app.sfm import pose_photos

STEPS = 30
FIT = ("--steps", STEPS, "--init", "scene", "--max-gaussians", 3000)


class Posed(NamedTuple):
    """Photos whose cameras were found: their folder, that of the results, the report and what was said."""

    photos: Path
    out: Path
    report: dict[str, Any]
    lines: list[str]


@pytest.fixture(scope="session")
def posed(tmp_path_factory: pytest.TempPathFactory) -> Posed:
    """Three small photos of two planes."""
    pytest.importorskip("pycolmap")
    root = tmp_path_factory.mktemp("posed")
    lines: list[str] = []
    report = pose_photos(write_planes(root / "photos", small_planes()), root / "out", say=lines.append)
    return Posed(root / "photos", root / "out", report, lines)


@pytest.fixture(scope="session")
def fitted(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of `kgs fit` with the options `FIT`; nobody changes them."""
    out = tmp_path_factory.mktemp("fitted")
    assert run("fit", folder, "-o", out, *FIT) == 0
    return out
