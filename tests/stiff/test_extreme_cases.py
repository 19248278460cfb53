"""The cases of `kgs bench extremes`: every bound is met, and a miss is seen."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from kgs.bench import extremes as module
from kgs.bench.extremes import SCENES, cases, errors, extremes
from kgs.bench.scenes import Scene


def test_every_scene_has_its_line() -> None:
    assert [case["case"] for case in cases()] == list(SCENES)


@pytest.fixture(scope="module", autouse=True)
def _one_reference_for_all_backends() -> Iterator[None]:
    """The dense reference takes longer than all backends: it is rendered once for a scene and near plane."""
    references: dict[tuple[float, bytes], object] = {}
    exact = module.exact

    def remembered(scene: Scene, near_plane: float) -> object:
        cloud, camera = scene
        numbers = [*vars(cloud).values(), camera.extrinsics, camera.intrinsics]
        key = near_plane, torch.cat([x.detach().double().flatten() for x in numbers]).numpy().tobytes()
        if key not in references:
            references[key] = exact(scene, near_plane)
        return references[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "exact", remembered)
        yield


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("case", cases(), ids=lambda case: case["case"])
def test_every_bound_is_met(case: dict[str, object], dtype: str, each_device: torch.device) -> None:
    row = errors(case, dtype, each_device)
    assert row["verdict"] == "met", row
    assert math.isfinite(row["forward"])
    assert math.isfinite(row["gradient"])


def test_files_lines_and_a_missed_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    met = cases()[0]
    monkeypatch.setattr(module, "cases", lambda: [met, {**met, "forward_float32": 1e-9}])
    assert extremes(out=tmp_path / "new") == 1
    with (tmp_path / "new" / "extremes.csv").open() as file:
        assert [row["verdict"] for row in csv.DictReader(file)] == ["met", "met", "MISSED", "met"]
    page = (tmp_path / "new" / "extremes.md").read_text()
    assert page.count("MISSED") == 1
    assert page.count("| ordinary |") == 2
    assert capsys.readouterr().out.endswith("1 of 4 bounds are missed\n")
    monkeypatch.setattr(module, "cases", lambda: [met])
    assert extremes(out=tmp_path / "new") == 0


def test_an_error_that_is_not_a_number_misses_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoilt(*args: object, **options: object) -> object:
        image, gradients = render(*args, **options)
        gradients["quats"][0] = math.nan
        return image, gradients

    render = module.render
    monkeypatch.setattr(module, "render", spoilt)
    assert errors(cases()[0], "float64")["verdict"] == "MISSED"
