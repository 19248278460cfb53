"""The page of `kgs fit --live`: it shows the splat as it grows, changes no bit of it, and ends with the fit."""

from __future__ import annotations

import json
import os
import re
import signal
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from threading import Semaphore, Thread
from typing import Any
from urllib.error import URLError

import pytest
import torch
from browser import Browser
from command import run

from kgs._support.errors import TrainingDiverged
from kgs.app import fit_folder as app
from kgs.app import live
from kgs.app.files.results_folder import CHECKPOINT
from kgs.app.scene_request import SceneRequest
from kgs.fit.checkpoint import load_checkpoint
from kgs.fit.config import FitConfig, Recipe
from kgs.fit.trainer import Trainer

CONFIG = FitConfig(steps=8, evaluations=1, max_gaussians=300, sh_degree=1, recipe=Recipe(grad_threshold=1e-5))


@pytest.fixture(autouse=True)
def _at_every_step(points: Any, monkeypatch: Any) -> None:
    """Show every step that a page waits for, of a fit with few points."""
    monkeypatch.setattr(app, "choose_points", lambda *_: points)
    monkeypatch.setattr(live, "_PAUSE", 0.0)
    monkeypatch.setattr(live, "_SHARE", 1e9)


class Watcher(Thread):
    """What a page reads, as long as there is a server."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self.url = url
        self.read: list[tuple[dict[str, Any], bytes]] = []

    def run(self) -> None:
        version = 0
        while not (self.read and self.read[-1][0]["isOver"]):
            try:
                with urllib.request.urlopen(f"{self.url}splat?after={version}", timeout=30) as answer:
                    line, _, content = answer.read().partition(b"\n")
            except (URLError, OSError):
                return
            self.read.append((json.loads(line), content))
            version = self.read[-1][0]["version"]

    @property
    def texts(self) -> list[str]:
        return [entry["text"] for entry, _ in self.read]


class Fit:
    """A fit with a page, and somebody who watches it from its first step on."""

    def __init__(self, scene: Any, out: Path, config: FitConfig = CONFIG, is_watched: bool = True) -> None:
        self.lines: list[str] = []
        self.watcher: Watcher | None = None
        self.is_watched = is_watched
        self.error: BaseException | None = None
        try:
            app.fit_folder(scene, config, out, SceneRequest("/photos", 3), live=True, say=self.say)
        except (KeyboardInterrupt, TrainingDiverged) as error:
            self.error = error
        if self.watcher:
            self.watcher.join(20)
        with pytest.raises(URLError, match="refused"):
            urllib.request.urlopen(self.url, timeout=5)

    @property
    def url(self) -> str:
        return next(found[0] for found in (re.search(r"http://\S+/", line) for line in self.lines) if found)

    def say(self, line: str) -> None:
        self.lines.append(line)
        if "http://" in line and self.is_watched:
            self.watcher = Watcher(self.url)
            self.watcher.start()


@pytest.fixture
def slow_steps(monkeypatch: Any) -> None:
    """Steps that take as long as a page needs to ask again, at least."""
    step = Trainer._optimize

    def slow(self: Trainer) -> float:
        time.sleep(0.05)
        return step(self)

    monkeypatch.setattr(Trainer, "_optimize", slow)


def test_it_shows_the_splat_as_it_grows_and_changes_no_bit_of_it(scene: Any, tmp_path: Path, slow_steps: None) -> None:
    app.fit_folder(scene, CONFIG, tmp_path / "plain", SceneRequest("/photos", 3))
    fit = Fit(scene, tmp_path / "live")
    assert (tmp_path / "live/splat.ply").read_bytes() == (tmp_path / "plain/splat.ply").read_bytes()
    states = [load_checkpoint(tmp_path / name / CHECKPOINT) for name in ("plain", "live")]
    for name, value in states[0]["model"].items():
        assert torch.equal(value, states[1]["model"][name]), name

    at = fit.lines.index("2 of 4: fit")
    assert re.search(r"open http://127\.0\.0\.1:\d+/[\w-]{22}/ in a browser", fit.lines[at + 1])
    assert fit.watcher
    read = fit.watcher.read
    assert fit.watcher.texts[0] == "step 0 of 8, 150 Gaussians"
    steps = [int(text.split()[1]) for text in fit.watcher.texts if text.startswith("step")]
    assert steps == sorted(steps)
    assert len(set(steps)) > 3
    splats = [content for _, content in read if content]
    assert len(set(splats)) > 3
    assert [entry["isOver"] for entry, _ in read] == [False] * (len(read) - 1) + [True]
    assert fit.watcher.texts[-1] == f"The fit is done. Its page: {tmp_path / 'live' / 'index.html'}"


def test_many_gaussians_are_easy_to_read() -> None:
    page = object.__new__(live.LivePage)
    page._steps = 900
    assert page._words(300, 41000) == "step 300 of 900, 41\N{NO-BREAK SPACE}000 Gaussians"


def test_it_ends_with_a_fit_that_fails(scene: Any, tmp_path: Path, slow_steps: None, monkeypatch: Any) -> None:
    monkeypatch.setattr("kgs.fit.trainer.gradient_fault", lambda model: "expected finite gradients")
    fit = Fit(scene, tmp_path)
    assert isinstance(fit.error, TrainingDiverged)
    assert fit.watcher
    assert "has failed" in fit.watcher.texts[-1]


def test_it_ends_with_a_fit_that_is_stopped(scene: Any, tmp_path: Path, slow_steps: None, monkeypatch: Any) -> None:
    step = Trainer._optimize

    def interrupted(self: Trainer) -> float:
        if self.step == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return step(self)

    monkeypatch.setattr(Trainer, "_optimize", interrupted)
    fit = Fit(scene, tmp_path)
    assert fit.error is None
    assert fit.watcher
    assert fit.watcher.texts[-1] == f"The fit was stopped at step 4. Its page: {tmp_path / 'index.html'}"


def test_it_ends_with_an_interrupt_after_training(scene: Any, tmp_path: Path, monkeypatch: Any) -> None:
    def interrupted(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(app, "_write_results", interrupted)
    fit = Fit(scene, tmp_path)
    assert isinstance(fit.error, KeyboardInterrupt)
    assert fit.watcher
    assert fit.watcher.texts[-1] == "The fit was interrupted."


def test_nothing_is_copied_for_nobody(scene: Any, tmp_path: Path, monkeypatch: Any) -> None:
    copied = live._copied
    copies = []
    monkeypatch.setattr(live, "_copied", lambda model: copies.append(len(model)) or copied(model))
    Fit(scene, tmp_path, is_watched=False)
    assert len(copies) == 2  # before and after the training


def test_splats_wait_until_their_share_of_the_time_allows_them(
    scene: Any, tmp_path: Path, slow_steps: None, monkeypatch: Any
) -> None:
    monkeypatch.setattr(live, "_SHARE", 0.0)
    fit = Fit(scene, tmp_path)
    assert fit.watcher
    assert len([0 for text in fit.watcher.texts if re.fullmatch(r"step \d of 8, \d+ Gaussians", text)]) == 1


def test_a_fit_goes_on_where_there_is_no_port(scene: Any, tmp_path: Path, monkeypatch: Any) -> None:
    def without(*_: object) -> None:
        raise OSError("no port")

    monkeypatch.setattr(live, "LiveServer", without)
    lines: list[str] = []
    app.fit_folder(scene, CONFIG, tmp_path, SceneRequest("/photos", 3), live=True, say=lines.append)
    assert "there is no live page: no port" in lines
    assert (tmp_path / "splat.ply").exists()


def test_the_command_names_the_address(folder: Path, tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    assert run("fit", folder, "-o", tmp_path, "--init", "random", "--init-points", 50, "--steps", 3, "--live") == 0
    assert len(re.findall(r"^open http://127\.0\.0\.1:\d+/[\w-]{22}/ in a browser", capsys.readouterr().out, re.M)) == 1


DRAWN = "viewer.draw(), document.querySelector('canvas').toDataURL()"
TEXT = "document.querySelector('.live').textContent"


def test_the_splat_on_the_page_changes_and_the_eye_does_not(scene: Any, tmp_path: Path, monkeypatch: Any) -> None:
    step = Trainer._optimize
    allowed = Semaphore(0)
    lines: list[str] = []

    def when_allowed(self: Trainer) -> float:
        assert allowed.acquire(timeout=60)
        return step(self)

    monkeypatch.setattr(Trainer, "_optimize", when_allowed)
    config = replace(CONFIG, steps=60)
    arguments = (scene, config, tmp_path / "out", SceneRequest("/photos", 3))
    fit = Thread(target=lambda: app.fit_folder(*arguments, live=True, say=lines.append), daemon=True)
    with Browser(tmp_path / "chromium") as browser:
        browser.size(800, 700, motion="no-preference")
        fit.start()
        while not any("http://" in line for line in lines):
            time.sleep(0.01)
        url = re.search(r"http://\S+/", " ".join(lines))
        assert url
        browser.open(url[0], "window.viewer && viewer.renderer.splat.count > 0")
        assert browser.run("viewer.tour") is None  # which would take the time of the fit
        assert browser.run(TEXT) == "step 0 of 60, 150 Gaussians"
        browser.run("viewer.turn(0.1, 0.05)")
        eye = browser.run("JSON.stringify(viewer.eye)")
        first = browser.run(DRAWN)
        assert browser.run(DRAWN) == first
        for _ in range(config.steps - 1):  # a step that ends while the page draws is not shown
            allowed.release()
            time.sleep(0.05)
            if int(browser.run(TEXT).split()[1]) >= 15:
                break
        assert browser.run(TEXT).startswith("step ")
        second = browser.run(DRAWN)
        assert abs(browser.picture(second) - browser.picture(first)).max() > 0.05
        assert browser.run("JSON.stringify(viewer.eye)") == eye
        for _ in range(config.steps):
            allowed.release()
        browser.wait(f"{TEXT}.startsWith('The fit is done. Its page: ')")
        assert browser.run(DRAWN) != second
        assert browser.run(f"{TEXT}.endsWith('index.html')")
        assert browser.problems == []
        assert {re.sub(r"\d+$", "", asked) for asked in browser.requests} <= {url[0], f"{url[0]}splat?after="}
        fit.join(60)
        assert not fit.is_alive()
