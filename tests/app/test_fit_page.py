"""The page that a fit leaves: what it says of the fit, of its cameras, and of what was not measured."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from factories import random_views
from fits_in_folders import fit_in
from tiny_scenes import narrow_lpips

from kgs._support.json_files import read_json
from kgs.app.cli.evaluate import evaluate
from kgs.app.page import fit_page
from kgs.app.page.fit_page import spread, write_fit_page, write_own_page
from kgs.app.saved_fit import load_fit
from kgs.app.scene_request import SceneRequest
from kgs.datasets import Views, synthetic_scene
from kgs.fit.config import FitConfig
from kgs.metrics.lpips import Lpips

CONFIG = FitConfig(steps=3, evaluations=2, max_gaussians=300, sh_degree=0)
REQUEST = SceneRequest("/photos/mine/room", train_views=3)
REPORT = {
    "photos": {"a.jpg": {"points": 70, "blurred": True}, "b.jpg": {"points": 90, "blurred": False}},
    "matches": [["a.jpg", "b.jpg", 123]],
    "focal_px": 123.456,
    "gates": {"max_degrees": 2.0, "passed": True},
    "seconds": {"matches": 3.0, "cameras": 1.5},
    "sha256": ["0123abcd"],
}


@pytest.fixture(scope="module")
def fitted(points: Any, tmp_path_factory: Any) -> Any:
    """A folder, and the fit in it."""
    out = tmp_path_factory.mktemp("fitted")
    photos = tmp_path_factory.mktemp("photos")
    scene = replace(synthetic_scene(train_views=3, test_views=8, size=(24, 32), seed=0), root=photos)
    (photos / "photos.json").write_text(json.dumps(REPORT))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgs.fit.run.choose_points", lambda *_: points)
        return out, fit_in(scene, CONFIG, out, REQUEST, say=lambda line: None).fit


@pytest.fixture
def rewritten(fitted: Any, tmp_path: Path) -> Any:
    """Writes the page of the same fit with another scene or measures into another folder; its text."""
    out, fit = fitted

    def text(**changes: Any) -> str:
        write_own_page(tmp_path, out, replace(fit, **changes), REQUEST, read_json(out / "config.json"))
        return (tmp_path / "index.html").read_text(encoding="utf-8")

    return text


def test_it_says_what_the_fit_knows(fitted: Any) -> None:
    out, _ = fitted
    text = (out / "index.html").read_text(encoding="utf-8")
    assert "<h1>room</h1>" in text
    assert "mine" not in text
    assert "<p>Three photos, eight more held out. Drag to look around.<" in text
    assert text.count(' of 11, held out" data-photo') == 8
    assert text.count('<img alt="" src="data:image/jpeg') == 11
    assert "--detail" not in text  # the photos have the size of the fit
    assert "6 of 8 test photos." in text
    assert "No photo was held out" not in text
    assert text.count('class="render"') == 6
    assert spread(25, 6) == [0, 5, 10, 14, 19, 24]
    assert f"{json.loads((out / 'metrics.json').read_text(encoding='utf-8'))['test']['psnr']:.2f}" in text
    facts = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text))
    assert facts["points in a photo"] == "70 to 90"
    assert facts["blurred"] == "a.jpg"
    assert facts["matches of a pair"] == "123 to 123"
    assert facts["gates: passed"] == "yes"
    assert facts["time"] == "4 s"
    assert facts["scene"] == "room"
    assert facts["cameras"] == "3 training and 8 test"
    assert facts["photo size"] == "32 × 24 pixels"
    assert re.findall(r"photo (\d+) of 11", facts["files"]) == [str(i) for i in range(1, 12)]
    assert facts["steps"] == "3"
    assert "0123abcd" not in text


def test_the_cameras_of_another_scene_are_not_on_it(fitted: Any, rewritten: Any) -> None:
    out, fit = fitted
    facts = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", rewritten(scene=replace(fit.scene, root=out / "other"))))
    assert "blurred" not in facts
    assert "time" not in facts


def test_without_a_photo_held_out_training_views_are_shown(fitted: Any, rewritten: Any) -> None:
    fit = fitted[1]
    scene = replace(fit.scene, test=fit.scene.test.select([]))
    text = rewritten(scene=scene, metrics=fit.metrics | {"test": None, "seen": None})
    assert "No photo was held out" in text
    assert "The training photos." in text
    assert text.count('class="render"') == 3


def test_it_says_that_a_larger_fit_is_possible(fitted: Any, tmp_path: Path) -> None:
    out, fit = fitted
    for downscale, expected in ((1.05, None), (4.0, 128), (100.0, 1000)):
        write_own_page(tmp_path, out, fit, replace(REQUEST, downscale=downscale), {})
        text = (tmp_path / "index.html").read_text(encoding="utf-8")
        assert re.findall(r"--detail</span> high takes (\d+)", text) == ([] if expected is None else [str(expected)])


def test_thumbnails_show_photos_as_they_were_taken(fitted: Any, tmp_path: Path) -> None:
    """Of photos that were turned for the fit, in an order of their own, and all turned by a quarter."""
    fit = fitted[1]
    train = fit.scene.train
    ramp = torch.linspace(0, 1, 32).expand(3, 24, 32)  # brighter to the right
    views = replace(train, images=ramp.expand(3, -1, -1, -1), turned=(False, True, False))
    scene = replace(fit.scene, train=views, test=fit.scene.test.select([]))
    for roll in (0.0, 90.0):
        write_fit_page(tmp_path / "a.html", "a", {"": replace(fit, scene=scene)}, roll=roll)
        text = (tmp_path / "a.html").read_text(encoding="utf-8")
        pictures = re.findall(r'<img alt="" src="data:image/jpeg;base64,(.*?)"', text)
        shown = [cv2.imdecode(np.frombuffer(base64.b64decode(one), np.uint8), cv2.IMREAD_GRAYSCALE) for one in pictures]
        lying, standing = (24, 32), (32, 24)
        for i, picture in enumerate(shown):
            is_turned_back = i == 1
            assert picture.shape == (lying if is_turned_back == bool(roll) else standing)
            rows, columns = (np.diff(picture.astype(float).mean(axis)).sum() for axis in (1, 0))
            # turned back, brighter to the top; turned clockwise, right is down, and top is right
            wanted = {(0, 0): (0, 1), (1, 0): (-1, 0), (0, 1): (1, 0), (1, 1): (0, 1)}[is_turned_back, bool(roll)]
            assert (round(rows / 250), round(columns / 250)) == wanted


def fit_of(folder: Path, out: Path, **changes: Any) -> None:
    """A fit of few steps and points."""
    request = SceneRequest(str(folder), 3, **changes)
    config = replace(CONFIG, init="random", init_points=50)
    fit_in(request.load(out), config, out, request, say=lambda line: None)


def test_a_page_without_photos_shows_none(folder: Path, tmp_path: Path) -> None:
    fit_of(folder, tmp_path, photos=False)
    for again in (False, True):
        if again:
            evaluate(tmp_path)
        text = (tmp_path / "index.html").read_text(encoding="utf-8")
        assert "data:image" not in text
        assert "held out of the training" in text


@pytest.fixture(scope="module")
def measured(folder: Path, tmp_path_factory: Any) -> Path:
    """A folder with a fit of another scene, which is read again."""
    out: Path = tmp_path_factory.mktemp("measured")
    fit_of(folder, out, background="white", roll=90.0)
    return out


@pytest.fixture
def done(measured: Path, tmp_path: Path) -> Path:
    """A copy of it for this test alone."""
    shutil.copytree(measured, tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_the_scene_and_the_fit_come_back(folder: Path, measured: Path) -> None:
    request, fit = load_fit(measured)
    assert request == SceneRequest(str(folder), 3, background="white", roll=90.0)
    assert fit.scene.background.tolist() == [1.0, 1.0, 1.0]
    assert fit.psnr(fit.scene.test) == pytest.approx(fit.metrics["test"]["psnr"], abs=1e-4)


def test_eval_adds_lpips_to_measures_and_page(done: Path, monkeypatch: Any, capsys: Any) -> None:
    with narrow_lpips():
        lpips = Lpips()
    monkeypatch.setattr(Lpips, "load", lambda weights: lpips)
    monkeypatch.setattr("kgs.metrics.weights.weight_files", lambda folder: None)  # looked for before torch is loaded
    before = json.loads((done / "metrics.json").read_text(encoding="utf-8"))
    (done / "index.html").unlink()
    evaluate(done, lpips_weights=done)
    after = json.loads((done / "metrics.json").read_text(encoding="utf-8"))
    for part in ("test", "train"):
        for row, old in zip([after[part], *after[part]["views"]], [before[part], *before[part]["views"]], strict=True):
            assert row["lpips_vgg"] != 0
            assert row["lpips_vgg_unscaled"] != row["lpips_vgg"]
            assert row["psnr"] == old["psnr"]
    assert f"LPIPS {after['test']['lpips_vgg']:.4g}" in capsys.readouterr().out
    assert ">LPIPS</th>" in (done / "index.html").read_text(encoding="utf-8")
    assert (done / "index.html").stat().st_size > 50_000


def flat_views(alphas: Any = None, border_mask: Any = None) -> Views:
    """Two photos of 20 x 30 pixels: grey inside, of two colours at the border."""
    images = torch.full((2, 3, 20, 30), 0.5)
    for image, colour in zip(images, ([0.2, 0.4, 0.6], [0.4, 0.4, 0.8]), strict=True):
        image[:, [0, -1], :] = torch.tensor(colour)[:, None, None]
        image[:, :, [0, -1]] = torch.tensor(colour)[:, None, None]
    return replace(random_views(2, 20, 30), images=images, alphas=alphas, border_mask=border_mask)


def test_the_ground_is_the_mean_of_the_photos_border() -> None:
    black = torch.zeros(3)
    torch.testing.assert_close(fit_page._ground(flat_views(), black), torch.tensor([0.3, 0.4, 0.7]))
    assert torch.equal(fit_page._ground(flat_views(alphas=torch.ones(2, 1, 20, 30)), black), black)
    assert torch.equal(fit_page._ground(flat_views(), torch.ones(3)), torch.ones(3))
    light = torch.zeros(20, 30)
    light[3:-3, 3:-3] = 1.0  # a dark border that no photo shows the scene in
    torch.testing.assert_close(fit_page._ground(flat_views(border_mask=light), black), torch.full((3,), 0.5))
