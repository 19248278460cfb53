"""Mistakes in a command line: one line names the option or file, and nothing is written."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest
from command import one_line, run
from factories import random_model
from tiny_scenes import write_colmap

import kgs


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene whose photos are too small to be fitted."""
    scene: Path = tmp_path_factory.mktemp("small")
    write_colmap(scene)
    return scene


@pytest.fixture(scope="module")
def splats(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A file without Gaussians, and a folder that is called like a file."""
    root = tmp_path_factory.mktemp("splats")
    paths = {name: root / f"{name}.ply" for name in ("empty", "folder")}
    kgs.save_ply(paths["empty"], random_model(0))
    paths["folder"].mkdir()
    return paths


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("fit {scene} -o {out} --views 99", "--views: expected"),
        ("fit {scene} -o {out} --init file --init-file {missing}", "missing"),
        ("fit {scene} -o {out} --max-gaussians 0", "--max-gaussians: expected"),
        ("fit {scene} -o {out} --drop 1", ", got 1.0"),  # a number, not a text
        ("fit {scene} -o {out} --device cuda:99", "--device: expected"),
        ("fit {scene} -o {scene}", "{scene}: expected a new or empty folder"),
        ("fit {scene} -o {scene}/transforms_train.json", "expected a folder for results"),
        ("fit {scene} -o {out} --size 31", "--size: expected at least 32 pixels"),
        ("fit {scene} -o {out} --size small", "--size: expected pixels, field"),
        ("fit {scene} -o {out} --size images_9", "images_9"),
        ("fit {scene} -o {out} --roll 400", "--roll: expected"),
        ("fit {scene} -o {out} --downscale 2", "--downscale: expected at least 32 pixels, got photos"),
        ("fit {scene} --views 3", "-o: expected a folder for the results, for example kgs fit {scene} --views 3 -o "),
        ("fit {small} -o {out}", "{small}: images: expected at least 32 pixels"),
        ("eval {scene} --lpips-weights {missing}", "missing"),
        ("render {file} --cameras {scene} -o {out} --downscale 0.5", "--downscale: expected"),
        ("render {file} --cameras {scene} -o {scene}/train", "{scene}/train: expected a new or empty folder"),
        ("render {file} --cameras {scene}", " -o transforms_train-render"),
        ("page {missing} --cameras {scene} -o {scene}.html", "missing"),
        ("fit {scene} -o ''", "--out: expected a path, got ''"),
        ("fit '' -o {out}", "scene: expected a path, got ''"),
        ("fit ''", "scene: expected a path, got ''"),
        ("fit {scene} -o {out} --masks=", "--masks: expected a path, got ''"),
        ("fit {scene} -o {out} --depths=", "--depths: expected a path, got ''"),
        ("fit {scene} -o {out} --depths {scene} --init random", "--depths: expected none without the init 'dense'"),
        ("fit {scene} -o {out} --init file --init-file ''", "--init-file: expected a path, got ''"),
        ("eval {fit} --device foo", "--device: expected"),
        ("page {splat} --cameras {scene} -o {out}/page.html", "expected a folder to write it to"),
        ("page {empty} --cameras {scene} -o {here}/page.html", "empty.ply: Gaussians: expected at least one"),
        ("render {empty} --cameras {scene} -o {out}", "empty.ply: Gaussians: expected at least one"),
        ("clean {splat} -o {here}/a.ply --strength -1", "--strength: expected"),
        ("clean {empty} -o {here}/a.ply", "empty.ply: Gaussians: expected at least one"),
        ("clean {fit} -o {here}/a.ply --cameras {scene}", "--cameras: expected a PLY file as SPLAT"),
        ("clean {fit} -o {here}/a.ply --downscale 2", "--downscale: expected a PLY file as SPLAT"),
        ("clean {splat} -o {here}/a.ply --downscale 2", "--downscale: expected --cameras"),
        ("clean {splat} -o {here}/a.ply --cameras {fit}/test", "{fit}/test"),
        ("clean {file} -o {here}/a.ply", "got one without 'ply' in the first line"),
        ("clean {splat} -o {splat}", "--out: expected another file"),
        ("export {splat} -o {out}.sog", "--out: "),
        ("export {splat} -o {folder}", "folder.ply: expected a file"),
        ("export {empty} -o {here}/a.ply", "empty.ply: vertex: "),
        ("export {folder} -o {here}/a.ply", "folder.ply/config.json"),
        ("page {splat} -o {here}/a.html", "--cameras: expected the scene of the PLY file"),
        ("render {splat} -o {out}", "--cameras: expected the scene of the PLY file"),
        ("export {splat} -o {splat}", "--out: "),  # the rounded file would take the place of the plain one
        ("scale {fit} --by 1,2,3 4,5,6 2 -o {fit}", "{fit}"),  # which has the fit that goes on from its checkpoint
        ("scale {here} --by 1,2,3 4,5,6 2 -o {out}", "config.json"),
        ("scale {splat} --by 1,2,3 4,5,6 2 -o {out}", "--out"),
        ("scale {splat} --by 1,2,3 4,5,6 2 -o {splat}", "--out"),
        ("scale {fit} --by 1,2,3 4,5,x 1 -o {out}", "--by: "),
        ("scale {fit} --by 1,2,3 4,5,nan 1 -o {out}", "--by: "),
        ("scale {fit} --by -1,2,0.5 -1.0,2,0.50 1 -o {out}", "--by: "),  # the same point twice
        ("scale {fit} --by -1,2,0.5 -1,2,0.50001 1e308 -o {out}", "--by: "),
        ("scale {fit} --by 1,2,3 4,5,6 -2 -o {out}", "--by: "),
        ("scale {fit} --by 1,2,3 4,5,6 inf -o {out}", "--by: "),
        (
            "nonsense",
            "one of demo, fit, poses, render, eval, page, clean, scale, export, check, bench, study, got 'nonsense'",
        ),
        ("bench nonsense", "one of speed, precision, extremes, got"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(
    folder: Path, small: Path, splats: dict[str, Path], fitted: Path, tmp_path: Path, capsys: Any, words: str, said: str
) -> None:
    """Those that need the scene or torch; the others are in test_cli_process.py."""
    paths = {"missing": tmp_path / "missing", "scene": folder, "small": small, "out": tmp_path / "out", "fit": fitted}
    paths |= {"here": tmp_path, "file": folder / "transforms_train.json", "splat": fitted / "splat.ply", **splats}
    roots = (folder, fitted, splats["empty"].parent)
    before = [(path, path.stat().st_mtime_ns) for root in roots for path in sorted(root.rglob("*"))]
    code = run(*(word.format(**paths) for word in shlex.split(words)))
    line = one_line(capsys)
    assert said.format(**paths) in line
    assert code == (3 if line.startswith("kgs: /") else 2)  # a file, or the words of the command line
    assert [(path, path.stat().st_mtime_ns) for root in roots for path in sorted(root.rglob("*"))] == before
    assert list(tmp_path.iterdir()) == []  # nothing was begun
