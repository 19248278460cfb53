"""Files for the user: names of their own, and folders that cannot be used are found before any work."""

import json
import os

import cv2
import pytest
import torch

from kgs._support.errors import DataError
from kgs._support.json_files import write_json, write_whole
from kgs.app.files.outputs import check_folder, png_names, write_png
from kgs.app.files.publishing import replacing


def test_each_view_has_a_picture_of_its_own():
    views = ["v.png", "v.bmp", "V.PNG", "images/v.png", "images_v.png", "é.png", "e\u0301.png", ".hidden", "a\nb.png"]
    views += [f"{'folder' * 25}/{'x' * 130}{k}.png" for k in range(3)] + ["漢" * 200, "..\\up.jpg", "\udcff.jpg"]
    names = list(png_names(views).values())
    assert len({name.casefold() for name in names}) == len(views)
    assert all(name.endswith(".png") and len(os.fsencode(name)) <= 200 for name in names)
    assert not any(set(name) & set("/\\\n\0") for name in names)
    assert png_names(views) == dict(zip(views, names, strict=True))  # the same again
    plain = ["test/r_0", "IMG_1.JPG", "images/v.1.png"]
    assert list(png_names(plain).values()) == ["test_r_0.png", "IMG_1.png", "images_v.1.png"]


def test_a_png_keeps_its_pixels_also_under_a_long_name(tmp_path):
    image = torch.arange(60).reshape(3, 4, 5) / 255
    (name,) = png_names([f"{'x' * 130}/{'y' * 130}.png"]).values()
    write_png(tmp_path / name, image)
    pixels = cv2.cvtColor(cv2.imread(str(tmp_path / name)), cv2.COLOR_BGR2RGB)
    assert torch.equal(torch.from_numpy(pixels).permute(2, 0, 1), (image * 255).round().byte())


def test_no_results_among_the_files_of_a_scene(tmp_path):
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (scene / "poses_bounds.npy").write_bytes(b"")
    (scene / "images" / "photo.JPG").write_bytes(b"")
    for out in (scene, scene / "images", tmp_path / "." / "scene" / "images"):
        with pytest.raises(DataError, match="files of a scene"):
            check_folder(out, scene)
    with pytest.raises(DataError, match="files of a scene"):
        check_folder(scene, tmp_path / "another scene")
    check_folder(scene / "results", scene)
    with replacing(scene / "results", "renders") as new:
        write_png(new / "a.png", torch.zeros(3, 4, 5))
    check_folder(scene / "results", scene)  # again: those pictures are kgs's


@pytest.mark.parametrize("name", ["file", "file/below", "file/below/that", "dangling"])
def test_a_folder_that_cannot_be_is_found_at_once(tmp_path, name):
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DataError, match="expected a folder for results"):
        check_folder(tmp_path / name)


def test_a_folder_without_permission_is_found_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)  # tests may run as root, who has every permission
    with pytest.raises(DataError, match="no permission for"):
        check_folder(tmp_path / "new")


def test_looking_makes_nothing(tmp_path):
    check_folder(tmp_path / "new" / "folder", make=False)
    assert os.listdir(tmp_path) == []
    check_folder(tmp_path / "new" / "folder")
    assert os.listdir(tmp_path / "new") == ["folder"]


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
