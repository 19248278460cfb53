"""`kgs fit` of unposed photos, with their true cameras instead of found ones: what follows from them."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from command import one_line, run
from kornia.geometry.conversions import rotation_matrix_to_quaternion

from kgs._support.errors import DataError
from kgs.app import sfm
from kgs.app.details import COARSE, DETAILS
from kgs.app.files.outputs import write_png
from kgs.app.sfm.source import Source
from kgs.datasets import synthetic_scene
from kgs.datasets.folders import scene_nearby
from kgs.datasets.synthetic import synthetic_depths

SIZE = (72, 96)
FIT = ("--steps", 2, "--init", "random", "--init-points", 200, "--preset", "plain")


@pytest.fixture(scope="module")
def truth():
    return synthetic_scene(train_views=9, test_views=1, size=SIZE).train


@pytest.fixture
def folder(truth, tmp_path):
    """A folder of unposed photos; `folder(4)` has the first four."""

    def made(count):
        folder = tmp_path / f"photos{count}"
        folder.mkdir()
        for i in range(count):
            write_png(folder / f"IMG_{i}.png", truth.images[i])
        return folder

    return made


@pytest.fixture(autouse=True)
def asked(truth, monkeypatch):
    """True cameras instead of found ones; the names of the photos that were asked for."""
    calls = []

    def true_cameras(opened, new, *_):
        names = [photo.name for photo in opened]
        calls.append(names)
        model = new / "sparse" / "0"
        model.mkdir(parents=True)
        (new / "images").mkdir()
        for photo in opened:
            shutil.copy(photo.path, new / "images")
        (height, width), matrix = SIZE, truth.cameras.intrinsics[0]
        lens = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
        (model / "cameras.txt").write_text(f"1 PINHOLE {width} {height} {' '.join(str(float(x)) for x in lens)}\n")
        (model / "points3D.txt").write_text("")
        lines = []
        for name in names:
            pose = truth.cameras.extrinsics[int(name[4:-4])].double()
            numbers = [*rotation_matrix_to_quaternion(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()]
            lines += [f"{name[4:-4]} {' '.join(map(str, numbers))} 1 {name}", ""]
        (model / "images.txt").write_text("\n".join(lines) + "\n")
        sizes = {"size": [width, height], "photo_size": [2 * width, 2 * height]}
        return {"photos": {name: {"image": name} for name in names}, **sizes, "versions": {"kgs": "0"}}

    monkeypatch.setattr("kgs.app.sfm.pose.find_cameras", true_cameras)
    return calls


def test_a_folder_of_photos_becomes_a_fit(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    out = tmp_path / "out"
    photos = folder(4)
    assert run("fit", photos, "-o", out, *FIT) == 0
    said = capsys.readouterr().out
    stages = ["1 of 5: cameras", "2 of 5: initial points", "3 of 5: fit", "4 of 5: film", "5 of 5: page"]
    assert [line for line in said.splitlines() if " of 5: " in line] == stages
    assert "4 training photos of 96x72, none held out" in said
    assert "<title>photos4</title>" in (out / "index.html").read_text(encoding="utf-8")
    assert "no photo was held out" in said
    assert json.loads((out / "metrics.json").read_text())["test"] is None
    assert not (out / "test").exists()
    assert f"kgs render {out} -o" in said
    request = json.loads((out / "config.json").read_text())["request"]
    assert (request["scene"], request["hold_out"], request["downscale"]) == (".", 0, 1.0)
    assert run("fit", tmp_path / "photos4", "-o", out, *FIT) == 0  # again, in the folder that it made
    out.rename(tmp_path / "moved")
    assert run("eval", tmp_path / "moved") == 0


def test_depth_maps_give_initial_points_and_are_not_needed_again(folder, truth, tmp_path, capsys):
    photos = folder(4)
    depths = tmp_path / "depths"
    depths.mkdir()
    for i, values in enumerate(synthetic_depths(truth.cameras)[:3, 0]):
        np.save(depths / f"IMG_{i}.npy", 1 / values.numpy())
    out = tmp_path / "out"
    fit = ("--init-points", 1500, "--preset", "plain", "--depths", depths)
    assert run("fit", photos, "-o", out, "--steps", 2, *fit) == 0
    said = capsys.readouterr().out
    assert "training photos without a depth map: 1 (IMG_3.png)" in said
    (line,) = [line for line in said.splitlines() if line.startswith("initial points from depth maps: ")]
    assert "from the maps of 3 of 4 photos" in line
    assert json.loads((out / "config.json").read_text())["request"]["depths"] == str(depths)
    shutil.rmtree(depths)
    assert run("eval", out) == 0


def test_cameras_alone_make_a_scene_that_is_fitted_as_its_photos_are(folder, tmp_path, capsys):
    photos = folder(4)
    scene = tmp_path / "scene"
    assert run("poses", photos, "-o", scene) == 0
    assert f"next: kgs fit {scene} -o scene-fit" in capsys.readouterr().out
    splats = []
    for source in (photos, scene):
        out = tmp_path / f"of {source.name}"
        assert run("fit", source, "-o", out, *FIT) == 0
        splats.append((out / "splat.ply").read_bytes())
    assert splats[0] == splats[1]
    capsys.readouterr()
    for source, out, said in (
        (scene, tmp_path / "more", "photos without camera poses, got a scene"),
        (photos, tmp_path / "of photos4", "expected a folder for photos, got one of kgs with fit"),
    ):
        assert run("poses", source, "-o", out) == 3
        assert said in one_line(capsys)
    assert run("poses", photos, "-o", tmp_path / "more", "--frames", 5) == 2
    assert not (tmp_path / "more").exists()


def test_half_of_the_steps_are_coarse_at_the_size_that_the_command_chooses(folder, tmp_path, monkeypatch):
    seen = []

    def fit_folder(scene, config, *args, **kwargs):
        seen.append(config.coarse)
        raise DataError(tmp_path, "", "no more")

    monkeypatch.setattr("kgs.app.fit_folder.fit_folder", fit_folder)
    photos = folder(4)
    cases = [
        ([], COARSE),
        (["--coarse", 0], 0.0),
        (["--size", 48], None),
        (["--detail", "low"], DETAILS["low"].entries["coarse"]),
        (["--preset", "paper"], 0.0),
    ]
    assert run("poses", photos, "-o", tmp_path / "scene") == 0
    for options, _ in cases:
        for source in (photos, tmp_path / "scene"):
            assert run("fit", source, "-o", tmp_path / f"{source.name} out", *options) == 3
    assert seen == [coarse for _, coarse in cases for _ in range(2)]


def test_a_second_fit_measures_a_photo_that_it_leaves_out(folder, tmp_path, capsys):
    photos = folder(5)
    splats = []
    for out, options in (("without", ["--hold-out", 5]), ("measured", []), ("measured", ["--measure", "--resume"])):
        assert run("fit", photos, "-o", tmp_path / out, *FIT, *options) == 0
        splats.append((tmp_path / out / "splat.ply").read_bytes())
    said = capsys.readouterr().out
    assert splats[1] == splats[2]  # of all photos
    metrics = json.loads((tmp_path / "measured" / "metrics.json").read_text())
    assert (metrics["test"], len(metrics["train"]["views"])) == (None, 5)
    (row,) = metrics["held_out"]["views"]
    assert f"a fit without {row['name']} shows it with PSNR {row['psnr']:.4g}" in said
    assert said.count("no photo was held out") == 1
    assert metrics["held_out"] == json.loads((tmp_path / "without" / "metrics.json").read_text())["test"]
    page = (tmp_path / "measured" / "index.html").read_text(encoding="utf-8")
    assert "1 photo held out of another fit with the same settings" in page
    for options in (["--hold-out", 2], ["--views", 3]):
        assert run("fit", photos, "-o", tmp_path / "out", "--measure", *options) == 2
        assert "--measure: expected photos" in one_line(capsys)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--downscale 4", "--downscale: expected 32 pixels or more of the longer side, got 24x18 of 96x72"),
        ("--backend triton", "triton"),
        ("--device meta", "--device: expected"),
        ("--init file --init-file {photos}/IMG_0.png", "expected a point cloud or mesh"),
    ],
)
def test_what_cannot_work_is_refused_before_cameras_are_found(
    folder, tmp_path, asked, capsys, monkeypatch, options, said
):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    photos = folder(9)
    words = options.format(photos=photos).split()
    assert run("fit", photos, "-o", tmp_path / "out", *words) == (3 if "--init-file" in options else 2)
    assert said in one_line(capsys)
    assert asked == []
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", ["--size 48 --coarse 0.5", "--size 32", "--downscale 9.3"])
def test_panoramas_that_get_too_low_are_refused_before_cameras_are_found(tmp_path, asked, capsys, options):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        write_png(photos / f"{i}.png", torch.zeros(3, 50, 300))
    assert run("fit", photos, "-o", tmp_path / "out", *options.split()) == 2
    assert " pixels or more of the shorter side, got " in one_line(capsys)
    assert asked == []


def test_photos_are_told_from_scenes(folder, tmp_path, asked):
    unposed = folder(4)
    assert Source.open(unposed).scene is None
    with pytest.raises(DataError, match="nothing"):
        Source.open(tmp_path / "nothing")
    sfm.pose_photos(unposed, unposed / "out")
    assert Source.open(unposed).scene is None  # what kgs made of them does not count
    assert Source.open(unposed / "out").scene.layout == "COLMAP"
    (unposed / "scene" / "sparse" / "0").mkdir(parents=True)
    shutil.copytree(unposed / "out" / "sparse", unposed / "scene" / "sparse", dirs_exist_ok=True)
    assert scene_nearby(unposed) == unposed / "scene"
    with pytest.raises(DataError, match="give that folder"):
        Source.open(unposed)
