"""`kgs demo`: the photos of the package, what is made of them, and whose they are."""

import json
import os
import re
import shutil
import statistics
from pathlib import Path

import cv2
import pytest
import torch
from command import one_line, run
from epipolar import sampson_distances
from PIL import Image

import kgs
from kgs.app.demo_scene import PHOTOS, SIDE, write_bananas, write_room
from kgs.app.page.fit_page import MAX_PICTURES
from kgs.datasets import load_scene, synthetic_scene
from kgs.datasets.splits import select_evenly
from kgs.fit.config import DROP
from kgs.geometry.rigs import camera_centers

TINY = ("--size", "40")
PHOTO_SIZE = 335, 504  # height and width of the photos of the package


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bananas")
    write_bananas(folder)
    return load_scene(folder)


def test_the_photos_are_small_hold_no_metadata_and_have_their_licence_beside_them():
    photos = sorted(PHOTOS.glob("*.jpg"))
    assert len(photos) == 8
    assert sum(path.stat().st_size for path in PHOTOS.iterdir()) < 550_000
    for path in photos:
        with Image.open(path) as photo:
            assert photo.size == PHOTO_SIZE[::-1]
            assert not photo.getexif()
            assert not {"exif", "comment", "xmp", "icc_profile"} & photo.info.keys()
    text = (PHOTOS / "LICENSE").read_text(encoding="utf-8")
    assert all(words in text for words in ("dataset_banana", "MIT License", "Copyright (c) 2019 Piero Toffanin"))


def test_two_photos_between_others_are_held_out(scene):
    """By the angles at which the cameras look, seen from above."""
    assert (len(scene.train), len(scene.test)) == (6, 2)
    assert not set(scene.train.names) & set(scene.test.names)
    angles = [torch.atan2(*v.cameras.extrinsics[:, 2, [0, 2]].T) for v in (scene.train, scene.test)]
    assert angles[0].min() < angles[1].min()
    assert angles[1].max() < angles[0].max()
    assert torch.pdist(camera_centers(torch.cat([v.cameras.extrinsics for v in (scene.train, scene.test)]))).min() > 0


def test_the_cameras_fit_the_photos(scene):
    """SIFT matches of two neighbours lie on each other's epipolar lines."""
    first, second = (scene.train.names.index(f"images/DSC_{number}.jpg") for number in ("0423", "0425"))
    distances = sampson_distances(scene.train, first, second, 0.7)
    assert len(distances) > 60
    assert float(distances.median()) < 0.5  # pixels


def test_the_photos_are_those_of_the_package_with_their_licence(scene):
    assert scene.train.images.shape[-2:] == PHOTO_SIZE
    assert max(PHOTO_SIZE) == SIDE
    for path in (*PHOTOS.glob("*.jpg"), PHOTOS / "LICENSE"):
        assert (scene.root / "images" / path.name).read_bytes() == path.read_bytes()


def test_the_room_is_written_as_it_is_but_for_eight_bits(tmp_path):
    write_room(tmp_path, 48, seed=3)
    read, made = load_scene(tmp_path), synthetic_scene(train_views=3, test_views=3, size=(36, 48), seed=3)
    for one, other in ((read.train, made.train), (read.test, made.test)):
        assert one.names == tuple(f"images/{name}.png" for name in other.names)
        assert (one.images - other.images.clamp(0, 1)).abs().max() <= 0.5 / 255 + 1e-6
        torch.testing.assert_close(one.cameras.intrinsics, other.cameras.intrinsics)
        centers = camera_centers(one.cameras.extrinsics).double() + read.offset
        torch.testing.assert_close(centers, camera_centers(other.cameras.extrinsics).double(), atol=1e-5, rtol=0)
        rotations = (views.cameras.extrinsics[:, :3, :3] for views in (one, other))
        torch.testing.assert_close(*rotations, atol=1e-6, rtol=0)


@pytest.fixture(scope="module")
def demo(tmp_path_factory, points):
    """The results of a tiny demo, and what was said; nobody changes them."""
    out = tmp_path_factory.mktemp("demo") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgs.fit.run.choose_points", lambda *_: points)
        assert run("demo", "-o", out, "--steps", 2, *TINY) == 0
    return out


def test_the_folder_of_the_demo_is_that_of_a_fit_with_its_photos(demo):
    metrics = json.loads((demo / "metrics.json").read_text())
    assert (metrics["steps"], metrics["drop"], metrics["protocol"]["image_size"]) == (2, DROP, [27, 40])
    assert len(metrics["test"]["views"]) == 2
    names = {"index.html", "demo.png", "curve.png", "splat.ply", "config.json", "images", "transforms.json"}
    assert names <= set(os.listdir(demo))
    assert "Piero Toffanin, dataset_banana (MIT licence)" in Path(demo, "index.html").read_text(encoding="utf-8")
    assert cv2.imread(str(demo / "demo.png")) is not None


@pytest.mark.parametrize(
    "words",
    [
        "eval {demo}",
        "scale {demo} --by 0,0,0 0,0,1 2.5 -o {out}",
        "clean {demo} -o {out}.ply",
        "render {demo}/splat.ply --cameras {demo} -o {out}",
    ],
)
def test_every_command_works_on_it(demo, tmp_path, words):
    before = json.loads((demo / "metrics.json").read_text())
    assert run(*words.format(demo=demo, out=tmp_path / "out").split()) == 0
    assert json.loads((demo / "metrics.json").read_text()) == before
    if words.startswith("render"):
        assert len(os.listdir(tmp_path / "out")) == 10  # eight pictures, a marker and its lock


def test_a_page_measures_at_the_size_of_the_fit_unless_told_otherwise(demo, tmp_path, capsys):
    metrics = json.loads((demo / "metrics.json").read_text())
    views = sorted((*metrics["test"]["views"], *metrics["train"]["views"]), key=lambda view: view["name"])
    mean = statistics.fmean(views[i]["psnr"] for i in select_evenly(len(views), MAX_PICTURES))
    shutil.copy(demo / "splat.ply", tmp_path / "elsewhere.ply")
    # with the numbers of the fit; beside the settings of another program; in a size that was asked for
    (tmp_path / "config.json").write_text("[1]")
    cases = [
        (demo / "splat.ply", (), "40x27"),
        (tmp_path / "elsewhere.ply", (), "40x27"),
        (demo / "splat.ply", ("--downscale", 6.3), "80x53"),
    ]
    for ply, options, size in cases:
        assert run("page", ply, "--cameras", demo, "-o", tmp_path / "a.html", *options) == 0
        level = re.search(rf"8 photos of {size}, PSNR ([\d.]+)", capsys.readouterr().out)[1]
        assert (float(level) == pytest.approx(mean, abs=0.02)) == (not options)


def test_a_fit_to_a_scene_does_not_go_beside_the_photos_of_another(demo, folder, capsys):
    assert run("fit", folder, "-o", demo) == 3
    assert "expected a folder for fit, got one of kgs with photos" in one_line(capsys)


def test_the_room_is_a_scene_without_photos_of_others(tmp_path, capsys, points, monkeypatch):
    monkeypatch.setattr("kgs.fit.run.choose_points", lambda *_: points)
    for resume in ((), ("--resume",)):
        assert run("demo", "-o", tmp_path, "--scene", "room", "--steps", 2, *TINY, *resume) == 0
        said = capsys.readouterr().out
        assert "3 training photos of 40x30, 3 held out" in said
        assert ("resumed at step 2" in said) == bool(resume)
        assert "dataset_banana" not in said + Path(tmp_path, "index.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_fits_with_and_without_dropping_have_equal_starts(tmp_path, capsys):
    assert run("demo", "-o", tmp_path, "--steps", 12, *TINY, "--compare") == 0
    dropped, plain = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("metrics", "without"))
    assert (plain["drop"], dropped["drop"]) == (0.0, DROP)
    assert plain["init"] == dropped["init"]
    gain = dropped["test"]["psnr"] - plain["test"]["psnr"]
    assert f"{gain:+.2f} dB" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "demo.png")) is not None
    assert cv2.imread(str(tmp_path / "curve.png")) is not None
    assert len(kgs.load_ply(tmp_path / "splat.ply")) == dropped["gaussians"]
