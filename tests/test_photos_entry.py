"""`kgs fit` of bare photos, with their true cameras in the place of those that are found: what follows from them."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest
from kornia.geometry.conversions import rotation_matrix_to_quaternion

from kgs import cli
from kgs.datasets import synthetic_scene
from kgs.datasets.layouts import nearest_scene
from kgs.fit import photos
from kgs.fit.config import FitConfig
from kgs.fit.minutes import expected_minutes
from kgs.fit.photos import estimate as estimate_module
from kgs.fit.photos.entry import foretold, is_bare
from kgs.io.json_files import write_json

SIZE = (72, 96)
FIT = ("--steps", 6, "--init", "sift", "--max-gaussians", 3000, "--preset", "plain")


def run(*arguments):
    with pytest.raises(SystemExit) as stop:
        cli.main([str(argument) for argument in arguments])
    return stop.value.code


@pytest.fixture(scope="module")
def truth():
    return synthetic_scene(train_views=9, test_views=1, size=SIZE).train


@pytest.fixture
def folder(truth, tmp_path):
    """A folder of bare photos; `folder(4)` has the first four."""

    def made(count):
        place = tmp_path / f"photos{count}"
        place.mkdir()
        for i in range(count):
            pixels = (truth.images[i] * 255).round().byte().permute(1, 2, 0).numpy()
            cv2.imwrite(str(place / f"IMG_{i}.png"), np.ascontiguousarray(pixels[..., ::-1]))
        return place

    return made


@pytest.fixture(autouse=True)
def asked(truth, monkeypatch):
    """True cameras in the place of found ones; the folders that were asked for."""
    calls = []

    def true_cameras(folder, out, **_):
        calls.append(sorted(path.name for path in folder.iterdir() if path.is_file()))
        model = out / "sparse" / "0"
        model.mkdir(parents=True, exist_ok=True)
        (out / "images").mkdir(exist_ok=True)
        for name in calls[-1]:
            shutil.copyfile(folder / name, out / "images" / name)
        (height, width), matrix = SIZE, truth.cameras.intrinsics[0]
        lens = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
        (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {' '.join(str(float(x)) for x in lens)}\n")
        (model / "points3D.txt").write_text("")
        lines = []
        for name in calls[-1]:
            pose = truth.cameras.extrinsics[int(name[4:-4])].double()
            numbers = [*rotation_matrix_to_quaternion(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()]
            lines += [f"{name[4:-4]} {' '.join(map(str, numbers))} 1 {name}", ""]
        (model / "images.txt").write_text("\n".join(lines) + "\n")
        report = {"photos": {name: {"image": name} for name in calls[-1]}, "size": [width, height]}
        write_json(out / "photos.json", report | {"versions": {"kgs": "0"}})
        return report | {"folder": str(out)}

    monkeypatch.setattr(photos, "pose_photos", true_cameras)
    monkeypatch.setattr(estimate_module, "pose_photos", true_cameras)
    return calls


def test_a_folder_of_photos_becomes_a_fit(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("fit", folder(4), "-o", out, *FIT) == 0
    said = capsys.readouterr().out
    assert re.search(
        r"^4 photos, the smallest of 96x72: cameras in about \d+ s, the fit in \d+ s, at most 1\.\d GiB", said
    )
    assert "4 training and 0 test views of 96x72" in said
    assert "<title>photos4</title>" in (out / "index.html").read_text(encoding="utf-8")
    assert "no photo was held out" in said
    assert f"--cameras {out}" in said
    request = json.loads((out / "config.json").read_text())["request"]
    assert (request["scene"], request["hold_out"], request["downscale"]) == (".", 0, 1.0)
    assert run("fit", tmp_path / "photos4", "-o", out, *FIT) == 0  # again, in the folder that it made
    assert "the smallest of" not in capsys.readouterr().out  # cameras that are there take no time
    out.rename(tmp_path / "moved")
    assert run("eval", tmp_path / "moved") == 0


def test_of_nine_photos_every_eighth_is_held_out(folder, tmp_path):
    nine = folder(9)
    assert run("fit", nine, "-o", tmp_path / "out", *FIT) == 0
    protocol = json.loads((tmp_path / "out" / "metrics.json").read_text())["protocol"]
    assert protocol["test"] == ["IMG_0.png", "IMG_8.png"]
    assert run("fit", nine, "-o", tmp_path / "all", "--hold-out", 0, "--downscale", 1.5, *FIT) == 0
    protocol = json.loads((tmp_path / "all" / "metrics.json").read_text())["protocol"]
    assert (protocol["test"], protocol["image_size"]) == ([], [48, 64])


def test_the_estimate_leaves_each_photo_out_once(folder, tmp_path, monkeypatch, capsys, asked):
    monkeypatch.setattr("kgs.fit.photos.entry.FAST", FitConfig(steps=10, evaluations=1, init_points=1000))
    assert run("fit", folder(4), "-o", tmp_path / "out", "--estimate", *FIT) == 0
    names = [f"IMG_{i}.png" for i in range(4)]
    assert asked == [names, *([name for name in names if name != out] for out in names)]
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())["estimate"]
    assert [row["name"] for row in found["photos"]] == names
    levels = [row["psnr"] for row in found["photos"] if "psnr" in row]
    assert len(levels) == found["n"] >= 2
    assert found["psnr"] == pytest.approx(np.mean(levels), abs=1e-3)
    assert found["sd"] == pytest.approx(np.std(levels, ddof=1), abs=1e-3)
    assert 12 < found["psnr"] < 40
    assert f"estimate: PSNR {found['psnr']:.4g}" in capsys.readouterr().out
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert f"Views that no photo shows: {found['psnr']:.1f} dB" in page
    assert "No photo was held out" not in page


def test_what_cannot_be_estimated_is_refused(folder, tmp_path, capsys, asked):
    assert run("fit", folder(3), "-o", tmp_path / "out", "--estimate", *FIT) == 2
    assert "--estimate: expected at least 4 photos" in capsys.readouterr().err
    assert asked == []
    assert run("fit", folder(4), "-o", tmp_path / "posed", *FIT) == 0
    assert run("fit", tmp_path / "posed", "-o", tmp_path / "other", "--estimate", *FIT) == 2
    assert "--estimate: expected a folder of bare photos, got a scene with cameras" in capsys.readouterr().err


def test_photos_are_told_from_scenes(folder, tmp_path, asked):
    bare = folder(4)
    assert is_bare(bare)
    assert not is_bare(tmp_path / "nothing")
    photos.pose_photos(bare, bare / "out")
    assert is_bare(bare)  # what kgs made of them does not count
    assert not is_bare(bare / "out")
    (bare / "scene" / "sparse" / "0").mkdir(parents=True)
    shutil.copytree(bare / "out" / "sparse", bare / "scene" / "sparse", dirs_exist_ok=True)
    assert nearest_scene(bare) == bare / "scene"
    assert not is_bare(bare)


def test_what_large_photos_take_is_foretold(folder):
    """Sizes alone count: 4 photos of 4000x3000 are posed at 1600 pixels, and fitted at 504 on a CPU."""
    large = folder(4)
    for path in large.iterdir():
        cv2.imwrite(str(path), np.zeros((3000, 4000, 3), np.uint8))
    said = foretold(large, None, FitConfig(backend="torch"))
    found = re.fullmatch(r"4 photos, the smallest of 4000x3000: cameras in about (\d+) s, the fit in (\d+) s, .*", said)
    cameras, fit = map(int, found.groups())
    assert 10 <= cameras <= 30
    assert fit == round(60 * expected_minutes(504 * 378, FitConfig(backend="torch")))
    assert re.search(r"at most 1\.\d GiB of memory", said)
    assert "the fit in 90 s" in foretold(large, None, FitConfig(minutes=1.5))
    (large / "IMG_0.png").write_bytes(b"no image")
    assert foretold(large, None, FitConfig()) == ""
