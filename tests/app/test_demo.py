"""`kgs demo`: the photos of the package, what is made of them, and whose they are."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command import run
from PIL import Image

import kgs
from kgs.app.cli.demo import PHOTO_SIZE, PHOTOS, check_size, demo, load_demo
from kgs.fit.config import DROP
from kgs.geometry import camera_centers

TINY = ("--size", "32", "40")


@pytest.fixture(scope="module")
def scene():
    return load_demo("bananas", (378, 504), seed=0)


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
    photos = [(255 * image.permute(1, 2, 0).numpy()).astype(np.uint8) for image in scene.train.images]
    matrix = scene.train.cameras.intrinsics[0, :3, :3].double().numpy()
    first, second = (scene.train.names.index(f"DSC_{number}.jpg") for number in ("0423", "0425"))
    sift = cv2.SIFT_create()
    (points, marks), (others, other_marks) = (sift.detectAndCompute(photos[i], None) for i in (first, second))
    pairs = cv2.BFMatcher().knnMatch(marks, other_marks, k=2)
    good = [a for a, b in pairs if a.distance < 0.7 * b.distance]
    assert len(good) > 60
    motion = scene.train.cameras.extrinsics[second].double() @ scene.train.cameras.extrinsics[first].double().inverse()
    x, y, z = motion[:3, 3].tolist()
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(matrix)
    fundamental = inverse.T @ cross @ motion[:3, :3].numpy() @ inverse
    left = np.array([[*points[m.queryIdx].pt, 1.0] for m in good])
    right = np.array([[*others[m.trainIdx].pt, 1.0] for m in good])
    lines = left @ fundamental.T
    distances = np.abs((right * lines).sum(1)) / np.hypot(lines[:, 0], lines[:, 1])
    assert np.median(distances) < 0.5  # pixels


@pytest.mark.parametrize(
    ("size", "expected"), [((378, 504), PHOTO_SIZE), ((32, 40), (27, 40)), ((999, 999), PHOTO_SIZE)]
)
def test_photos_are_reduced_until_they_fit_and_never_enlarged(size, expected):
    assert load_demo("bananas", size, seed=0).train.images.shape[-2:] == expected


def test_pictures_that_are_too_small_are_refused(tmp_path):
    check_size("bananas", (12, 19))
    check_size("room", (12, 12))
    with pytest.raises(ValueError, match=r"^size: expected at least 12 19 for these photos, got 12 18"):
        demo(scene="bananas", size=(12, 18), out=tmp_path)
    for scene in ("bananas", "room"):
        with pytest.raises(ValueError, match=r"^size: expected at least 12 pixels a side, got 11 40"):
            demo(scene=scene, size=(11, 40), out=tmp_path)
    assert not [*tmp_path.iterdir()]


def test_photos_are_fitted_with_dropping(tmp_path, capsys, monkeypatch, points):
    """From random points: depth maps take most of the demo's time, and have tests of their own."""
    monkeypatch.setattr("kgs.fit.run.choose_points", lambda *_: points)
    assert run("demo", "-o", tmp_path, "--steps", 2, *TINY) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics) == {"with"}
    said = capsys.readouterr().out
    assert "difference on test views" not in said
    assert {"index.html", "demo.png", "curve.png", "splat.ply"} <= set(os.listdir(tmp_path))
    page = Path(tmp_path, "index.html").read_text(encoding="utf-8")
    for text in (said, page):
        assert "Piero Toffanin, dataset_banana (MIT licence)" in text


def test_the_room_is_a_scene_without_photos_of_others(tmp_path, capsys):
    assert run("demo", "-o", tmp_path, "--scene", "room", "--steps", 2, *TINY) == 0
    assert "3 training and 3 test views of 40x32" in capsys.readouterr().out
    assert "dataset_banana" not in Path(tmp_path, "index.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_fits_with_and_without_dropping_have_equal_starts(tmp_path, capsys):
    assert run("demo", "-o", tmp_path, "--steps", 12, *TINY, "--compare") == 0
    runs = json.loads((tmp_path / "metrics.json").read_text())
    assert set(runs) == {"without", "with"}
    assert (runs["without"]["drop"], runs["with"]["drop"]) == (0.0, DROP)
    assert runs["without"]["init"] == runs["with"]["init"]
    gain = runs["with"]["test"]["psnr"] - runs["without"]["test"]["psnr"]
    assert f"{gain:+.2f} dB" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "demo.png")) is not None
    assert cv2.imread(str(tmp_path / "curve.png")) is not None
    assert len(kgs.load_ply(tmp_path / "splat.ply")) == runs["with"]["gaussians"]
