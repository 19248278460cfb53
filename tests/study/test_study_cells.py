"""The study of sparse views: its cells, what one of them measures, and that it goes on where it stopped."""

import base64
import json

import cv2
import numpy as np
import pytest
import torch
from study_rows import tiny_cell

from kgs.fit.config import FitConfig
from kgs.study import cells as cells_module
from kgs.study.cells import sparse_cell
from kgs.study.presets import GUARD, METHODS, SCENES, sparse_cells


@pytest.mark.parametrize("preset", ["quick", "cpu", "field", "paper", "guard"])
def test_each_cell_is_there_once_and_is_a_fit(preset, tmp_path):
    for scene in (*SCENES, *GUARD):
        (tmp_path / scene).mkdir(parents=True, exist_ok=True)
    cells = sparse_cells(preset, tmp_path)
    assert len({json.dumps(cell, sort_keys=True) for cell in cells}) == len(cells)
    for method, settings in {cell["method"]: cell["fit"] for cell in cells}.items():
        assert all(cell["fit"] == settings for cell in cells if cell["method"] == method)
        config, _ = cells_module.fit_config("dense", 0, settings)
        assert config.drop == METHODS[method].get("drop", FitConfig().drop)


@pytest.mark.slow
def test_only_the_built_in_scene_is_shown(folder):
    """Photo, render and difference of a test view, in a few kilobytes."""
    pictures = sparse_cell(tiny_cell())["pictures"]
    assert sum(map(len, pictures)) < 40_000
    data = (base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")) for uri in pictures)
    photo, render, difference = (cv2.imdecode(np.frombuffer(one, np.uint8), 1).astype(float) for one in data)
    expected = cells_module._start(None, "synthetic", 2, None, "sift", 0, "paper")[0].test.images[0]
    grey = photo.mean(axis=2) / 255 - expected.mean(dim=0).numpy()
    assert np.abs(grey).mean() < 0.03  # of JPEG
    assert np.abs(difference - np.clip(4 * np.abs(render - photo), 0, 255)).mean() < 25  # their noise fourfold
    assert "pictures" not in sparse_cell(tiny_cell(seed=1))
    other = tiny_cell(start="scene") | {"scene": folder.name, "views": 4}
    assert "pictures" not in sparse_cell(other, data=str(folder.parent))


@pytest.mark.slow
def test_methods_of_a_seed_begin_with_the_same_points(monkeypatch):
    begun = []

    def trainer(scene, plan, first):
        begun.append((plan.config.drop, first.points))
        raise InterruptedError  # nothing else of the cell is wanted

    monkeypatch.setattr(cells_module, "Trainer", trainer)
    for method, seed in (("off", 0), ("fixed 0.1", 0), ("off", 1)):
        cells_module._start.cache_clear()  # as in another process
        with pytest.raises(InterruptedError):
            sparse_cell(tiny_cell(method, seed, start="random"))
    (off, first), (drop, second), (_, other) = begun
    assert (off, drop) == (0.0, 0.1)
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


@pytest.mark.slow
def test_a_scene_on_the_disk_and_its_own_points(folder):
    cell = tiny_cell(start="scene") | {"scene": folder.name, "views": 4, "downscale": 2.0}
    result = sparse_cell(cell, data=str(folder.parent))
    assert result["init"]["kind"] == "random"
    assert "come with the layout" in result["protocol"]["init"]
    assert result["protocol"]["image_size"] == [18, 20]
    assert (result["config"]["steps"], result["config"]["drop"]) == (3, 0.0)


@pytest.mark.slow
def test_lpips_is_measured_where_there_are_weights(kgs_data):
    result = sparse_cell(tiny_cell(), lpips_weights=str(kgs_data / "weights"))
    for part in ("test", "train"):
        lpips, unscaled = result[part]["lpips_vgg"], result[part]["lpips_vgg_unscaled"]
        assert 0 < lpips < 2
        assert 0 < unscaled != lpips
