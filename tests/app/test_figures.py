"""Figures and facts about the machine, without a display and without touching what is the caller's."""

import os
import re
import subprocess
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from factories import random_views

from kgs._support.machine import check_device, peak_rss_mb, revision
from kgs.app.files.figures import DEFAULT, WITHOUT, write_curve, write_sheet
from kgs.app.files.plot import psnr_plot
from kgs.datasets.scene import Views
from kgs.study.plots import STYLES
from kgs.study.presets import AUTO, OFF

CURVE = [{"step": k, "seconds": 0.1 * k, "test_psnr": 20.0 + k, "train_psnr": None} for k in range(3)]


@pytest.mark.parametrize("points", [0, 1, 2, 3])
def test_a_curve_is_drawn_from_whatever_was_measured(tmp_path, points):
    write_curve(tmp_path / "curve.png", {"": CURVE[:points]})
    picture = cv2.imread(str(tmp_path / "curve.png"))
    has_line = bool((picture == (167, 121, 204)).all(2).any())  # blue first
    assert has_line == (points > 1)
    assert (picture < 100).any()  # there are words


def test_a_curve_passes_through_its_points(tmp_path):
    """Where the page draws them, which has tests of its own."""
    write_curve(tmp_path / "curve.png", {"": CURVE})
    picture = cv2.imread(str(tmp_path / "curve.png"))
    drawn = psnr_plot({"": {"curve": CURVE}})
    for point in drawn["lines"][0]["points"].split():
        x, y = (round(2 * float(value)) for value in point.split(","))
        assert (picture[y - 1 : y + 2, x - 1 : x + 2] == (167, 121, 204)).all(2).any()


def test_each_method_has_one_colour_in_every_figure(tmp_path):
    without = [{**point, "test_psnr": 18.0} for point in CURVE]
    write_curve(tmp_path / "curve.png", {"with DropGaussian": CURVE, "without DropGaussian": without})
    pixels = cv2.imread(str(tmp_path / "curve.png")).reshape(-1, 3)
    counts = [int((pixels == color).all(1).sum()) for color in ((167, 121, 204), (0, 0, 0))]  # blue first
    assert min(counts) > 50
    style = files("kgs.app.page").joinpath("viewer.css").read_text()
    assert f".default {{ stroke: {DEFAULT.lower()}" in style
    assert (STYLES[AUTO][0], STYLES[OFF][0]) == (DEFAULT, WITHOUT)


def test_a_sheet_shows_the_photo_and_each_render(tmp_path):
    """Each cell is the nearest to its own picture, of all pictures on the sheet."""
    images = torch.rand(4, 3, 1, 1, generator=torch.Generator().manual_seed(0)).expand(4, 3, 32, 40)
    views = random_views(count=2, height=32, width=40)
    views = Views(views.cameras, images[:2], views.names)
    write_sheet(tmp_path / "sheet.png", views, {"one": [images[2], images[3]]}, [0, 1])
    sheet = torch.from_numpy(cv2.imread(str(tmp_path / "sheet.png"))[:, :, ::-1].copy()) / 255
    for row, column, image in ((0, 0, 0), (1, 0, 1), (0, 1, 2), (1, 1, 3)):
        pixel = sheet[28 + 140 + row * 290, 180 + column * 360]
        assert float((pixel - images[image, :, 0, 0]).abs().max()) < 0.01


@pytest.mark.slow
def test_the_peak_of_memory():
    before = peak_rss_mb()
    room = 0
    if (statm := Path("/proc/self/statm")).exists():  # the peak of earlier tests may lie far above
        room = before - int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 2**20
    block = np.ones((room + 256) * 2**20, np.uint8)
    assert 200 <= peak_rss_mb() - before <= 320
    assert block[-1]


def test_a_system_that_reports_no_peak_in_its_status(monkeypatch):
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: "VmSize: 5000 kB\nVmRSS: 3000 kB\n")
    assert peak_rss_mb() > 10


@pytest.mark.parametrize("name", ["foo", "", "cuda:x", "meta", "cuda:99", "privateuseone"])
def test_a_device_that_is_not_there_is_one_line(name):
    with pytest.raises(ValueError, match=r"^device: expected cpu or a GPU of this machine, got .*$") as caught:
        check_device(name)
    assert "\n" not in str(caught.value)
    assert check_device("cpu") == torch.device("cpu")


def test_the_commit_of_a_file(tmp_path):
    def git(*arguments):
        name = ("-c", "user.name=a", "-c", "user.email=a@b.example")
        subprocess.run(["git", "-C", tmp_path, *name, *arguments], check=True, capture_output=True)

    path = tmp_path / "sparse.jsonl"
    path.write_text("{}\n")
    assert revision(path) is None
    git("init")
    assert revision(path) is None
    git("add", ".")
    git("commit", "-m", "a", "--date", "2026-01-02T03:04:05Z")
    assert re.fullmatch(r"[0-9a-f]{7,} of \d{4}-\d\d-\d\d", revision(path))
    path.write_text("{}\n{}\n")
    assert revision(path).endswith(" and later changes")
