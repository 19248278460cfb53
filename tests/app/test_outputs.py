"""Files for the user: names of their own, marks by which kgs knows its own files, and nothing of the user's lost."""

import json
import os

import cv2
import numpy as np
import pytest
import torch

import kgs
from kgs.app.files.figures import write_curve
from kgs.app.files.outputs import check_folder, png_names, write_png
from kgs.app.files.ownership import is_own, remove_own_images
from kgs.errors import DataError
from kgs.json_files import write_json, write_whole

CURVE = [{"step": 1, "seconds": 0.1, "test_psnr": 20.0, "train_psnr": None}]


def test_each_view_has_a_picture_of_its_own():
    views = ["v.png", "v.bmp", "V.PNG", "images/v.png", "images_v.png", "é.png", "e\u0301.png", ".hidden", "a\nb.png"]
    views += [f"{'folder' * 25}/{'x' * 130}{k}.png" for k in range(3)] + ["漢" * 200, "..\\up.jpg", "\udcff.jpg"]
    names = list(png_names(views).values())
    assert len({name.casefold() for name in names}) == len(views)
    assert all(name.endswith(".png") and len(os.fsencode(name)) <= 200 for name in names)
    assert not any(set(name) & set("/\\\n\0") for name in names)
    assert png_names(views) == dict(zip(views, names, strict=True))  # the same again


def test_plain_names_stay_as_they_are():
    views = ["test/r_0", "IMG_1.JPG", "images/v.1.png"]
    assert list(png_names(views).values()) == ["test_r_0.png", "IMG_1.png", "images_v.1.png"]


def test_long_names_can_be_written(tmp_path):
    for name in png_names([f"{'x' * 130}/{'y' * 130}.png"]).values():
        write_png(tmp_path / name, torch.zeros(3, 4, 5))
    assert len(os.listdir(tmp_path)) == 1


def test_a_png_keeps_its_pixels_and_bears_a_mark(tmp_path):
    image = torch.arange(60).reshape(3, 4, 5) / 255
    write_png(tmp_path / "a.png", image)
    pixels = cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB)
    assert torch.equal(torch.from_numpy(pixels).permute(2, 0, 1), (image * 255).round().byte())
    assert is_own(tmp_path / "a.png")


def test_kgs_knows_its_own_files(tmp_path):
    model = kgs.GaussianModel.from_points(torch.rand(5, 3), torch.rand(5, 3), 0)
    kgs.save_ply(tmp_path / "splat.ply", model)
    write_curve(tmp_path / "curve.png", {"": CURVE})
    write_json(tmp_path / "metrics.json", {"versions": {"kgs": kgs.__version__}})
    assert all(is_own(tmp_path / name) for name in ("splat.ply", "curve.png", "metrics.json"))
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "other.ply").write_text("ply\nformat ascii 1.0\ncomment made by hand\n")
    (tmp_path / "other.json").write_text('{"name": "not of kgs"}')
    assert not any(is_own(tmp_path / name) for name in ("photo.png", "other.ply", "other.json", "none.png", ""))


@pytest.mark.parametrize("name", ["splat.ply", "config.json", "metrics.json", "curve.png", "test/a.png"])
def test_a_users_file_is_never_overwritten(tmp_path, name):
    (tmp_path / "test").mkdir()
    (tmp_path / name).write_text("mine")
    with pytest.raises(DataError, match="was not written by kgs"):
        check_folder(tmp_path, ["splat.ply", "config.json", "metrics.json", "curve.png", "test/a.png"])
    assert (tmp_path / name).read_text() == "mine"


def test_a_link_to_a_users_file_is_one(tmp_path):
    (tmp_path / "photo").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.png").symlink_to(tmp_path / "photo")
    with pytest.raises(DataError, match="was not written by kgs"):
        check_folder(tmp_path / "out", ["a.png"])


def test_no_results_among_the_files_of_a_scene(tmp_path):
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (scene / "poses_bounds.npy").write_bytes(b"")
    (scene / "images" / "photo.JPG").write_bytes(b"")
    for out in (scene, scene / "images", tmp_path / "." / "scene" / "images"):
        with pytest.raises(DataError, match="holds files of a scene"):
            check_folder(out, ["other.png"], scene)
    with pytest.raises(DataError, match="holds files of a scene"):
        check_folder(scene, ["other.png"], tmp_path / "another scene")
    check_folder(scene / "results", ["a.png"], scene)
    write_png(scene / "results" / "a.png", torch.zeros(3, 4, 5))
    check_folder(scene / "results", ["a.png"], scene)  # again: those pictures are kgs's


@pytest.mark.parametrize("name", ["file", "file/below", "file/below/that", "dangling"])
def test_a_folder_that_cannot_be_is_found_at_once(tmp_path, name):
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DataError, match="expected a folder for results"):
        check_folder(tmp_path / name, [])


def test_a_folder_without_permission_is_found_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)  # tests may run as root, who has every permission
    with pytest.raises(DataError, match="no permission for"):
        check_folder(tmp_path / "new", [])


def test_looking_makes_nothing(tmp_path):
    check_folder(tmp_path / "new" / "folder", ["a.png"], make=False)
    assert os.listdir(tmp_path) == []
    check_folder(tmp_path / "new" / "folder", ["a.png"])
    assert os.listdir(tmp_path / "new") == ["folder"]


def test_a_file_in_the_place_of_a_folder_is_kept(tmp_path):
    (tmp_path / "test").write_text("mine")
    with pytest.raises(DataError, match="was not written by kgs"):
        check_folder(tmp_path, ["test/a.png"])


def test_pictures_of_a_former_run_go_and_no_others(tmp_path):
    for name in ("now.png", "before.png"):
        write_png(tmp_path / name, torch.zeros(3, 4, 5))
    cv2.imwrite(str(tmp_path / "photo.png"), np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "note.txt").write_text("mine")
    remove_own_images(tmp_path, ["now.png"])
    assert sorted(os.listdir(tmp_path)) == ["note.txt", "now.png", "photo.png"]


def test_files_are_whole_or_as_they_were(tmp_path, monkeypatch):
    write_json(tmp_path / "a.json", {"a": 1})
    (tmp_path / "link.json").symlink_to(tmp_path / "a.json")
    write_json(tmp_path / "link.json", {"a": 2})
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "a.json").read_text())["a"] == 2
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"a": float("nan")})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.json'"):
        write_whole(tmp_path / "a.json", b"{}")
    assert sorted(os.listdir(tmp_path)) == ["a.json", "link.json"]
    assert json.loads((tmp_path / "a.json").read_text())["a"] == 2
