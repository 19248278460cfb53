"""`kgs export`: the compressed PLY file of a splat."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import run
from compressed_reader import decode
from factories import random_model

import kgs


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
    kgs.save_compressed_ply(tmp_path / "same.ply", kgs.load_ply(splat))
    assert out.read_bytes() == (tmp_path / "same.ply").read_bytes()


def test_an_origin_makes_map_coordinates_small(tmp_path: Path) -> None:
    model = random_model(20, 0)
    kgs.save_ply(tmp_path / "map.ply", model, torch.tensor([5e6, 6e6, 100.0]).double())
    out = tmp_path / "map.compressed.ply"
    assert run("export", tmp_path / "map.ply", "-o", out, "--origin", 5000000, 6000000, 100) == 0
    np.testing.assert_allclose(decode(out)["means"], model.means.detach().numpy(), atol=0.01)
