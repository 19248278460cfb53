"""`kgs scale`: a folder of a fit, or a PLY file, in the unit of a known length."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import run
from factories import as_model, random_gaussians

import kgs

A = "-1,2,0.5"
B = "1,2,0.5"  # two units away
LENGTH = 5


@pytest.fixture(scope="module")
def metres(fitted: Path, tmp_path_factory: Any) -> Path:
    """The same, where lengths are 2.5 times as large."""
    out: Path = tmp_path_factory.mktemp("metres") / "out"
    assert run("scale", fitted, "--by", A, B, LENGTH, "-o", out) == 0
    return out


def test_all_files_of_a_fit_are_scaled_alike(fitted: Path, metres: Path) -> None:
    before, after = (kgs.load_ply(folder / "splat.ply") for folder in (fitted, metres))
    torch.testing.assert_close(after.means, 2.5 * before.means, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(after().scales, 2.5 * before().scales)
    cameras = [json.loads((folder / "cameras.json").read_text()) for folder in (fitted, metres)]
    for old, new in zip(*cameras, strict=True):
        np.testing.assert_allclose(new["position"], 2.5 * np.array(old["position"]), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(new["rotation"], old["rotation"], atol=1e-6)
        np.testing.assert_allclose(new["bounds"], 2.5 * np.array(old["bounds"]), rtol=1e-4, atol=1e-5)
        assert (new["fx"], new["img_name"]) == (old["fx"], old["img_name"])
    documents = [content_of(folder / "splat.glb") for folder in (fitted, metres)]
    for name in ("min", "max"):
        old, new = (document["accessors"][0][name] for document in documents)
        np.testing.assert_allclose(new, 2.5 * np.array(old), rtol=1e-5)
    old, new = (document["nodes"][0]["translation"] for document in documents)
    np.testing.assert_allclose(new, 2.5 * np.array(old), rtol=1e-5, atol=1e-6)


def content_of(path: Path) -> Any:
    """The JSON of a GLB file."""
    content = path.read_bytes()
    length = struct.unpack("<I", content[12:16])[0]
    return json.loads(content[20 : 20 + length])


def test_the_page_is_scaled_too_and_says_so(fitted: Path, metres: Path) -> None:
    texts = [(folder / "index.html").read_text(encoding="utf-8") for folder in (fitted, metres)]
    assert "scaled by 2.5 after the fit" in texts[1]
    scenes = [json.loads(re.findall(r'id="splat">(.*?)</script>', text, re.DOTALL)[0])["scene"] for text in texts]
    for name in ("pyramid", "offset"):
        np.testing.assert_allclose(scenes[1][name], 2.5 * np.array(scenes[0][name]), rtol=1e-4, atol=1e-6)
    for old, new in zip(scenes[0]["cameras"], scenes[1]["cameras"], strict=True):
        np.testing.assert_allclose(new["position"], 2.5 * np.array(old["position"]), rtol=1e-5, atol=1e-6)
        assert new["distance"] == pytest.approx(2.5 * old["distance"], rel=1e-4)
    assert texts[0].count('class="render"') == texts[1].count('class="render"') > 0


def test_a_splat_far_from_the_origin_keeps_its_digits(tmp_path: Path) -> None:
    """In map coordinates, where float32 would hold steps of half a metre."""
    gaussians = random_gaussians(50, 0, torch.float32, sh_degree=1)
    model = as_model(gaussians)
    far = torch.tensor([4e6, -5e6, 300.0], dtype=torch.float64)
    kgs.save_ply(tmp_path / "a.ply", model, offset=far)
    a, b = "4000000,-5000000,300", "4000000,-5000003,304"
    assert run("scale", tmp_path / "a.ply", "--by", a, b, 10, "-o", tmp_path / "b.ply") == 0
    after = kgs.load_ply(tmp_path / "b.ply", origin=2 * far)
    torch.testing.assert_close(after.means, 2 * gaussians.means, rtol=0, atol=1e-5)
    torch.testing.assert_close(after().scales, 2 * gaussians.scales)
