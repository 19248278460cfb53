"""What is announced of a fit before it begins; how right it is was measured (docs/measured.md)."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from kgs.fit import forecast as forecasts
from kgs.fit.config import DETAILS, FitConfig
from kgs.fit.forecast import forecast, slowness

SMALL, LARGE = (189, 252), (378, 504)
CONFIG = FitConfig(sh_degree=0)


@pytest.fixture(autouse=True)
def as_fast_as_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forecasts, "slowness", lambda backend: (1.0, 1.0))


def test_time_grows_with_the_work() -> None:
    small = forecast(3, SMALL, CONFIG)
    for more in (
        forecast(3, LARGE, CONFIG),
        forecast(3, SMALL, replace(CONFIG, steps=4000)),
        forecast(3, SMALL, replace(CONFIG, init_points=60_000)),
    ):
        assert more.seconds["fit"] > 1.2 * small.seconds["fit"]
    assert forecast(6, SMALL, CONFIG).seconds["initial points"] == 2 * small.seconds["initial points"]
    assert forecast(3, LARGE, replace(CONFIG, coarse=0.5)).seconds["fit"] < forecast(3, LARGE, CONFIG).seconds["fit"]


def test_stages_that_there_are() -> None:
    assert list(forecast(3, SMALL, CONFIG).seconds) == ["start", "initial points", "fit", "film and page"]
    stages = forecast(8, SMALL, FitConfig(), 8, 1e6).seconds
    assert list(stages) == ["start", "cameras", "initial points", "probes", "fit", "film and page"]
    assert "initial points" not in forecast(3, SMALL, FitConfig(init="sift")).seconds
    assert (
        forecast(12, SMALL, CONFIG, 12, 1e6).seconds["cameras"]
        > 1.5 * forecast(6, SMALL, CONFIG, 6, 1e6).seconds["cameras"]
    )


def test_a_slower_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = forecast(3, SMALL, CONFIG, 3, 1e6).seconds
    monkeypatch.setattr(forecasts, "slowness", lambda backend: (2.0, 3.0))
    slow = forecast(3, SMALL, CONFIG, 3, 1e6).seconds
    assert slow["fit"] == pytest.approx(2 * usual["fit"])
    assert slow["cameras"] == pytest.approx(3 * usual["cameras"])


def test_measured_runs() -> None:
    """Seconds and MiB of runs on the machine that the constants are from, within the bounds that are promised."""
    normal, low, high = (replace(FitConfig(), **DETAILS[name].entries) for name in ("normal", "low", "high"))
    bananas, tree = (1064, 1600), (1600, 1200)
    for views, size, config, photos, kept, seconds, mebibytes in (
        (6, (665, 1000), high, 6, bananas, 272, 1272),
        (6, (251, 378), low, 6, bananas, 79, 956),
        (6, (504, 378), normal, 6, tree, 176, 1183),
    ):
        found = forecast(views, size, config, photos, kept[0] * kept[1])
        assert sum(found.seconds.values()) == pytest.approx(seconds, rel=0.3)
        assert found.memory / 2**20 == pytest.approx(mebibytes, rel=0.2)


def test_in_words() -> None:
    assert str(forecasts.Forecast({"start": 3.0, "fit": 140.0}, 1.5 * 2**30)) == (
        "this takes about 2.4 minutes (start 3 s, fit 2.3 minutes) and 1.5 GiB of memory"
    )
    assert str(forecasts.Forecast({}, 2**30)) == "this takes about 1.0 GiB of memory"


def test_the_machine_is_measured_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    calls = []
    monkeypatch.setattr(forecasts, "_median_seconds", lambda work: calls.append(work) or 0.5)
    first = slowness("torch")
    assert first == (pytest.approx(0.5 / 0.0034), pytest.approx(0.5 / 0.097))
    assert slowness("torch") == first
    assert len(calls) == 2
    path = tmp_path / "kgs" / "speed.json"
    kept = json.loads(path.read_text())
    path.write_text(json.dumps({**kept, **{key: "damaged" for key in kept}}))
    assert slowness("torch") == first
    path.unlink()
    path.parent.chmod(0o500)
    path.parent.rmdir()
    path.parent.write_text("a file where the folder should be")
    assert slowness("torch") == first


def test_what_is_measured_works() -> None:
    assert forecasts._median_seconds(forecasts._find_keypoints) > 0
    forecasts._render("torch")()
