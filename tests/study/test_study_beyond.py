"""The study's views beyond the photos: where cameras lie, which pixels count, and what a cell and the report hold."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from init_point_scenes import as_views

from kgs.datasets import synthetic_scene
from kgs.datasets.scene import Scene
from kgs.datasets.synthetic import room, synthetic_depths, views_beyond
from kgs.geometry.cameras import pinhole_cameras
from kgs.geometry.rigs import camera_centers
from kgs.study import beyond
from kgs.study.beyond import Target, beyond_cells, from_the_middle, measure_target, room_targets
from kgs.study.beyond_report import write_beyond
from kgs.study.command import study

SIZE = (24, 32)


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(3, 2, SIZE)


@pytest.fixture(scope="module")
def targets(scene):
    return room_targets(scene)


@pytest.mark.slow
def test_cameras_before_the_room_lie_so_many_times_as_far_out():
    for out in (1.0, 2.5):
        centers = camera_centers(views_beyond(out, 4, (6, 8)).cameras.extrinsics).numpy()
        flat = (centers - room.EYE)[:, :2] / room.PATCH[:2]
        np.testing.assert_allclose(np.linalg.norm(flat, axis=1), out, rtol=1e-4)
        np.testing.assert_allclose(centers[:, 2], room.EYE[2], atol=1e-5)


@pytest.mark.slow
def test_all_that_a_training_view_sees_counts_in_it(scene):
    depths = synthetic_depths(scene.train.cameras)[:, 0]
    count = beyond.views_that_show(depths[2], scene.train.camera(2), list(depths), scene.train.cameras)
    assert count.min() >= 1
    assert count.max() == 3


@pytest.mark.slow
def test_fewer_pixels_count_farther_out(targets):
    shares = [np.mean([float(shown.float().mean()) for shown in target.shown]) for target in targets.values()]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.9
    assert 0.3 < shares[-1] < 0.8


def test_only_pixels_that_count_are_compared():
    camera = pinhole_cameras(torch.eye(4), torch.eye(4), 3, 2)
    views = as_views(camera, torch.full((1, 3, 2, 3), 0.5))
    shown = torch.tensor([[True, True, False], [False, False, False]])
    image = torch.full((1, 3, 2, 3), 0.9)
    image[0, :, 0, :2] = 0.6  # off by 0.1 where pixels count: 20 dB
    found = measure_target(lambda _: image, Target(views, [shown]), lambda a, b, _: (a - b).abs().sum())
    assert found["psnr"] == pytest.approx(20.0, abs=1e-3)
    assert found["share"] == pytest.approx(1 / 3, abs=1e-4)
    assert found["lpips"] == pytest.approx(0.6, abs=1e-4)  # 3 channels of 2 pixels
    nothing = measure_target(lambda _: image, Target(views, [torch.zeros_like(shown)]))
    assert nothing == {"share": 0.0, "psnr": None, "lpips": None}


def scene_along(x, photos, **changes):
    """A scene of photos without points, by cameras at these x."""
    extrinsics = torch.eye(4).repeat(len(photos), 1, 1)
    extrinsics[:, 0, 3] = -torch.tensor(x)
    intrinsics = torch.eye(4).repeat(len(photos), 1, 1)
    views = as_views(pinhole_cameras(extrinsics, intrinsics, photos.shape[-1], photos.shape[-2]), photos)
    none = torch.zeros(0, 3)
    return Scene(
        views, views.select([]), none, none, "none", torch.zeros(3), torch.zeros(3), Path(), train_full_size=views
    )


def test_real_scenes_are_trained_from_the_middle_and_tested_outside():
    whole = scene_along([5.0, 0.0, -1.0, 1.0, -6.0, 2.0, -2.0, 0.9], torch.rand(8, 3, 2, 3))
    scene = from_the_middle(whole, 3)
    assert scene.train.names == scene.train_full_size.names == ("1.png", "2.png", "7.png")
    assert scene.test.names == ("0.png", "4.png")
    assert len(from_the_middle(whole, 7).test) == 1


def test_a_border_is_that_of_the_photos_in_the_middle():
    photos = torch.full((8, 3, 200, 40), 0.6)
    photos[2:5, :, 0] = 0.3
    scene = from_the_middle(scene_along(torch.arange(8.0).tolist(), photos), 3)
    for part in (scene.train, scene.test):
        assert part.border_mask is not None
        torch.testing.assert_close(part.border_mask[0], torch.full((40,), 0.5))
        assert float(part.border_mask[1:].min()) == 1.0


def test_cells_are_there_once_the_synthetic_ones_first(tmp_path):
    alone = beyond_cells(None)
    assert {cell["scene"] for cell in alone} == {beyond.ROOM}
    for scene in beyond.PHOTOS:
        (tmp_path / scene).mkdir(parents=True)
    cells = beyond_cells(tmp_path)
    assert cells[: len(alone)] == alone
    assert {cell["scene"] for cell in cells} == {beyond.ROOM, *beyond.PHOTOS}
    assert len({json.dumps(cell, sort_keys=True) for cell in cells}) == len(cells) == 12
    assert [cell["seed"] for cell in alone] == [0, 1, 2]


@pytest.mark.slow
def test_a_run_keeps_its_cells_and_reports(tmp_path, monkeypatch, threads):
    monkeypatch.setattr(beyond, "SIZE", SIZE)
    beyond._scene.cache_clear()
    cells = [cell | {"fit": {"steps": 3, "init": "sift", "evaluations": 1}} for cell in beyond_cells(None)[:2]]
    monkeypatch.setattr(beyond, "beyond_cells", lambda _: cells)
    monkeypatch.delenv("KGS_DATA", raising=False)
    assert study(out=tmp_path, preset="beyond", scheduler=threads) == 0
    beyond._scene.cache_clear()
    rows = [json.loads(line) for line in (tmp_path / "beyond.jsonl").read_text().splitlines()]
    assert [row["cell"]["scene"] for row in rows] == ["room"] * 2
    for row in rows:
        assert set(row["result"]["beyond"]) == {"1", "2", "3"}
        assert row["result"]["beyond"]["2"]["psnr"] > 5
    report = (tmp_path / "beyond.md").read_text(encoding="utf-8")
    assert "kgs study --preset beyond -o OUT" in report
    assert "2 of 2 cells" in report
    before = (tmp_path / "beyond.jsonl").read_bytes()
    assert study(out=tmp_path, preset="beyond", report_only=True) == 0
    assert (tmp_path / "beyond.jsonl").read_bytes() == before


def test_the_report_has_a_line_for_each_scene_with_its_seeds(tmp_path):
    whole = {"psnr": 25.0, "lpips_vgg_unscaled": 0.1}
    common = {"test": whole, "train": whole, "gaussians": 9, "wall_seconds": 2.0, "revision": "abc"}
    far = {"share": 0.5, "psnr": 20.0, "lpips": None}
    inside, *_ = cells = beyond_cells(None)
    rows = [{"cell": cell, "result": common | {"beyond": {str(k): far for k in beyond.OUT}}} for cell in cells[:2]]
    seen = {"seen": {"psnr": 22.0, "share": 0.7}, "beyond": {}}
    rows.append({"cell": inside | {"scene": "llff/fern"}, "result": common | seen})
    text = write_beyond(rows, tmp_path / "new", "COMMAND", 15)
    assert (tmp_path / "new" / "beyond.md").read_text(encoding="utf-8") == text.rstrip() + "\n"
    assert "3 of 15 cells; by commit of kgs: 3 abc" in text
    assert "| room, 3 views | auto | 2 | 25.00 (0.00); 0.100 (0.000) | 20.00 (0.00) |" in text
    assert "| llff/fern, 3 views | auto | 1 | 25.00; 0.100 | 22.00 | 0.70 |" in text
