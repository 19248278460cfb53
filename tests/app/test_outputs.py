"""Files for the user have names of their own, and are written whole."""

import json
import os

import cv2
import pytest
import torch

from kgs._support.json_files import write_json, write_whole
from kgs.app.files.outputs import png_names, write_png


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
