"""The study of sparse views: its cells, what one of them measures, and that it goes on where it stopped."""

import base64
import json
import math
import re
import sys
from collections import Counter
from itertools import product

import cv2
import numpy as np
import pytest
import torch
from study_rows import tiny_cell

from kgs.app.cli import main
from kgs.fit.config import FitConfig
from kgs.study import cells as cells_module
from kgs.study.cells import sparse_cell
from kgs.study.presets import AUTO, AUTO_OFF, GUARD, MAIN, METHODS, SCENES, sparse_cells


@pytest.fixture
def data(tmp_path):
    for scene in SCENES:
        (tmp_path / scene).mkdir(parents=True)
    return tmp_path


@pytest.fixture
def guarded(data):
    """With the scenes of the preset "guard", too."""
    for scene in GUARD:
        (data / scene).mkdir(parents=True, exist_ok=True)
    return data


# -- the cells ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", ["pandas", "distributed", "matplotlib", "scipy", "jinja2"])
def test_a_package_that_is_missing_is_named_before_any_work(package, tmp_path, monkeypatch, capsys):
    for name in [name for name in sys.modules if name.startswith(("kgs.bench.", "matplotlib."))]:
        parent, _, child = name.rpartition(".")
        if parent in ("kgs.bench", "matplotlib") and hasattr(sys.modules[parent], child):
            monkeypatch.setattr(sys.modules[parent], child, sys.modules[name])  # to be as before afterwards
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(SystemExit) as error:
        main(["study", "-o", str(tmp_path / "out")])
    assert error.value.code == 1
    said = capsys.readouterr().err
    assert re.match(rf"kgs: {package}\S* is missing: ", said)
    assert f"[{'app' if package in ('matplotlib', 'jinja2') else 'study'}]" in said
    assert not list(tmp_path.rglob("*.jsonl"))


@pytest.mark.parametrize("preset", ["quick", "cpu", "field", "paper", "guard"])
def test_each_cell_is_there_once_and_is_a_fit(preset, guarded):
    cells = sparse_cells(preset, guarded)
    assert len({json.dumps(cell, sort_keys=True) for cell in cells}) == len(cells)
    for method, settings in {cell["method"]: cell["fit"] for cell in cells}.items():
        assert all(cell["fit"] == settings for cell in cells if cell["method"] == method)
        config, _ = cells_module.fit_config("dense", 0, settings)
        assert config.drop == METHODS[method].get("drop", FitConfig().drop)


def settings(cells):
    return Counter((cell["scene"], cell["views"], cell["start"], cell["method"]) for cell in cells)


def all_seeds(scenes, methods, start="dense"):
    return {(*scene, start, method): 3 for scene, method in product(scenes, methods)}


def test_the_preset_field_begins_with_what_no_later_recipe_changes(data):
    cells = sparse_cells("field", data)
    forward, objects = [*SCENES.items()][:3], [*SCENES.items()][3:]
    assert settings(cells[:27]) == all_seeds(forward, MAIN)
    assert settings(cells[27:54]) == all_seeds(objects, MAIN)
    assert settings(cells[54:90]) == all_seeds(SCENES.items(), (AUTO, AUTO_OFF))
    for cell in cells:
        assert cell["fit"]["steps"] == (None if cell["method"] in (AUTO, AUTO_OFF) else 2000)
        assert cell["downscale"] is None
    (data / "colmap/fountain").mkdir()
    joined = [cell for cell in sparse_cells("field", data) if cell not in cells]
    fountain = [("colmap/fountain", 3), ("colmap/fountain", 6)]
    assert settings(joined) == all_seeds(fountain, ("off", "progressive 0.2", AUTO, AUTO_OFF))


def test_the_preset_cpu_holds_what_the_study_must_show(data):
    cells = sparse_cells("cpu", data)
    assert {cell["fit"]["steps"] for cell in cells} == {2000}
    first = cells[:6]  # methods of one start follow each other
    assert [cell["method"] for cell in first] == ["off", "progressive 0.2", "fixed 0.1"] * 2
    assert [(cell["scene"], cell["seed"]) for cell in first] == [("llff/fern", 0)] * 3 + [("llff/flower", 0)] * 3
    more_views = [*product(("llff/fern", "llff/flower"), (6, 9)), ("nerfstudio/fox", 6), ("colmap/monstree", 12)]
    expected = all_seeds(SCENES.items(), ("off", "progressive 0.2", "fixed 0.1", AUTO, AUTO_OFF))
    expected |= all_seeds(more_views, ("off", "progressive 0.2", AUTO, AUTO_OFF))
    expected |= all_seeds([("llff/fern", 3)], METHODS)
    expected |= all_seeds(SCENES.items(), ["progressive 0.2"], "sift")
    assert expected.items() <= settings(cells).items()


# -- one cell ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_cell_measures_and_repeats_bit_for_bit(monkeypatch):
    asked = []
    monkeypatch.setattr(cells_module, "revision", asked.append)
    results = [sparse_cell(tiny_cell("progressive 0.2")) for _ in range(2)]
    for result in results:
        json.dumps(result, allow_nan=False)
        assert math.isfinite(result["test"]["psnr"])
        assert result["test"]["lpips_vgg"] is None
        assert result["init"]["kind"] == "sift"
        assert result["gaussians"] == sum(result["thresholds"]["gaussians"])
        assert len(result["test_views"]) == len(result["protocol"]["test"])
        assert result["config"]["drop"] == 0.2
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", result["date"])
        for key in ("wall_seconds", "cpu_seconds", "peak_rss_mb", "curve", "date", "revision"):
            result.pop(key)
        result["init"].pop("seconds")
    assert results[0] == results[1]
    assert {path.name for path in asked} == {"kgs"}  # the commit is that of the whole package


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
