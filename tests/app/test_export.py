"""`kgs export`, and the compressed PLY file that a fit writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import one_line, run
from compressed_reader import decode, header
from factories import random_model, random_views

import kgs
from kgs.app.files import exports
from kgs.app.files.ownership import is_own
from kgs.datasets import Scene
from kgs.fit import Fit


@pytest.fixture
def splat(tmp_path: Path) -> Path:
    """A PLY file of 300 Gaussians."""
    kgs.save_ply(tmp_path / "splat.ply", random_model(300, 1))
    return tmp_path / "splat.ply"


def test_it_says_how_many_bytes_are_left(splat: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "small.compressed.ply"
    for _ in range(2):  # its own file may be replaced
        assert run("export", splat, "-o", out) == 0
    said = capsys.readouterr().out
    assert f"{out}: 300 Gaussians, 0.01 MB of 0.03" in said
    assert is_own(out)
    kgs.save_compressed_ply(tmp_path / "same.ply", kgs.load_ply(splat))
    assert out.read_bytes() == (tmp_path / "same.ply").read_bytes()


def test_an_origin_makes_map_coordinates_small(tmp_path: Path) -> None:
    model = random_model(20, 0)
    kgs.save_ply(tmp_path / "map.ply", model, torch.tensor([5e6, 6e6, 100.0]).double())
    out = tmp_path / "map.compressed.ply"
    assert run("export", tmp_path / "map.ply", "-o", out, "--origin", 5000000, 6000000, 100) == 0
    np.testing.assert_allclose(decode(out)["means"], model.means.detach().numpy(), atol=0.01)


def test_mistakes_are_a_line_and_change_nothing(splat: Path, tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "mine.ply").write_bytes(b"mine")
    kgs.save_ply(tmp_path / "none.ply", random_model(0))
    assert run("export", splat, "-o", tmp_path / "own.ply") == 0
    capsys.readouterr()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for given, out, said in (
        ("splat.ply", "a.sog", "--out: "),
        ("splat.ply", "mine.ply", "mine.ply: was not written by kgs"),
        ("splat.ply", "nowhere/a.ply", "a.ply: "),
        ("none.ply", "a.ply", "none.ply: vertex: "),
        ("own.ply", "own.ply", "--out: "),  # the rounded file would take the place of the plain one
    ):
        assert run("export", tmp_path / given, "-o", tmp_path / out) == 2
        assert said in one_line(capsys)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("far", [False, True])
def test_a_fit_writes_it_in_the_axes_of_the_ply_where_floats_can_hold_them(
    tmp_path: Path, monkeypatch: Any, far: bool
) -> None:
    """In map coordinates its origin is that of the scene, the mean of the training cameras' centres."""
    monkeypatch.setattr(exports, "write_film", lambda *_: "")
    none = torch.zeros(0, 3)
    offset = torch.tensor([5e8, -3e8, 0.0] if far else [50.0, -30.0, 0.0]).double()
    scene = Scene(random_views(2), random_views(1), none, none, "none", offset, torch.zeros(3), Path())
    model = random_model(100, 0)
    exports.write_exports(Fit(scene, model, kgs.RasterOptions()), tmp_path)
    found = decode(tmp_path / "splat.compressed.ply")["means"]
    expected = model.means.detach().double() + (0 if far else offset)
    np.testing.assert_allclose(found, expected.numpy(), atol=0.005)
    assert header(tmp_path / "splat.compressed.ply")[0][2] == "element chunk 1"


def test_a_fit_without_gaussians_has_none(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(exports, "write_film", lambda *_: "")
    none = torch.zeros(0, 3)
    scene = Scene(random_views(2), random_views(1), none, none, "none", torch.zeros(3).double(), torch.zeros(3), Path())
    exports.write_exports(Fit(scene, random_model(0), kgs.RasterOptions()), tmp_path)
    assert not (tmp_path / "splat.compressed.ply").exists()
