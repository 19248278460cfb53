"""Whole fits: the real scenes that KGS_DATA points to, and the demo over seeds. Minutes each."""

import json
import math
import statistics

import pytest

from kgs.cli import main

pytestmark = pytest.mark.slow

FILES = {"splat.ply", "metrics.json", "config.json", "curve.png", "checkpoint.safetensors", "test"}


def fit(scene, out, *arguments):
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(scene), "-o", str(out), *map(str, arguments)])
    assert stop.value.code == 0
    assert {path.name for path in out.iterdir()} >= FILES
    metrics = json.loads((out / "metrics.json").read_text())
    assert len(list((out / "test").iterdir())) == len(metrics["test"]["views"])
    return metrics


def test_fern_three_views(kgs_data, tmp_path):
    metrics = fit(kgs_data / "llff/fern", tmp_path, "--views", 3, "--downscale", 2, "--steps", 2000)
    assert metrics["test"]["psnr"] >= 23.9


@pytest.mark.parametrize(
    ("scene", "views", "floor"),
    [("llff/flower", 3, 21.0), ("colmap/trex", 3, 22.0), ("blender/lego", 8, 24.5), ("nerfstudio/fox", 12, 21.0)],
)
def test_other_scenes_finish(kgs_data, tmp_path, scene, views, floor):
    metrics = fit(kgs_data / scene, tmp_path, "--views", views, "--downscale", 2, "--steps", 1000)
    assert metrics["test"]["psnr"] >= floor


def test_dropping_gains_over_seeds(tmp_path):
    gains = []
    for seed in range(5):
        with pytest.raises(SystemExit):
            main(["demo", "-o", str(tmp_path / str(seed)), "--seed", str(seed)])
        runs = json.loads((tmp_path / str(seed) / "metrics.json").read_text())
        gains.append(runs["with"]["test"]["psnr"] - runs["without"]["test"]["psnr"])
    print("gains", gains)
    assert statistics.mean(gains) >= 2 * statistics.stdev(gains) / math.sqrt(len(gains))
