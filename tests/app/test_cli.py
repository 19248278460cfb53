"""The command `kgs`, as a user types it."""

import errno
import functools
import json
import os
import re
import shlex
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import torch
import tyro
from command import one_line, run
from factories import random_model

import kgs
from kgs._support.json_files import write_json
from kgs.app.cli.fit import first_config
from kgs.app.cli.run import COMMANDS, load_command
from kgs.app.cli.size import with_size
from kgs.app.cli.tools import explain_import_error, load_package, load_tools
from kgs.app.details import DETAILS
from kgs.app.files.fit_files import CHECKPOINT, EXPORTS, FILMS, PREVIOUS
from kgs.app.files.results import Results
from kgs.app.scene_request import SceneRequest
from kgs.datasets.source import SceneSource
from kgs.errors import ArgumentError, DataError, PhotosRefused, TrainingDiverged
from kgs.fit.config import DROP, PAPER, PRESETS, FitConfig

COMMAND_PAGE = (Path(__file__).parents[2] / "docs/command.md").read_text(encoding="utf-8")
QUICK = ("--init", "scene", "--max-gaussians", 3000)
STEPS = 30
FIT = (*QUICK, "--steps", STEPS)  # of the fixture `fitted`


def test_fit_writes_everything(fitted):
    files = set(os.listdir(fitted))
    results = {"config.json", "metrics.json", "splat.ply", "curve.png", "index.html", "test", CHECKPOINT, PREVIOUS}
    assert results | {*EXPORTS} - {*FILMS} <= files
    assert len(files & {*FILMS}) == 1
    assert "checkpoint.safetensors" in os.listdir(fitted)
    assert sorted(os.listdir(fitted / "test")) == ["test_r_0.png", "test_r_1.png"]
    assert cv2.imread(str(fitted / "test" / "test_r_0.png")).shape == (36, 40, 3)
    assert cv2.imread(str(fitted / "curve.png")) is not None


def test_a_fit_of_fewer_pixels_than_the_photos_have_names_detail_high(folder, tmp_path, monkeypatch, capsys):
    """Where --detail chose them; --size was a choice of the user."""
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setitem(DETAILS, "low", DETAILS["low"]._replace(size=32))
    quick = ("--steps", 2, "--evaluations", 1, *QUICK)
    for options, expected in ((("--detail", "low"), True), (("--size", 32), False)):
        assert run("fit", folder, "-o", tmp_path / "out", *options, *quick) == 0
        line = "the same command with --detail high fits 40 pixels instead of 32"
        assert (line in capsys.readouterr().out) == expected, options


def test_metrics_have_the_agreed_keys_and_say_what_the_splat_and_config_do(fitted):
    metrics = json.loads((fitted / "metrics.json").read_text())
    assert set(metrics) == {
        "test", "train", "curve", "seconds", "peak_rss_mb", "gaussians", "decisions", "steps", "seed", "drop", "init",
        "backend", "protocol", "versions", "seen", "poses", "outlines",
    }  # fmt: skip
    assert set(metrics["test"]) == {"psnr", "ssim", "ssim_zero_padded", "lpips_vgg", "lpips_vgg_unscaled", "views"}
    assert metrics["test"]["lpips_vgg"] is None
    assert set(metrics["curve"][-1]) == {"step", "seconds", "test_psnr", "train_psnr"}
    assert metrics["curve"][-1]["train_psnr"] == pytest.approx(metrics["train"]["psnr"], abs=1e-2)  # before pruning
    assert (metrics["steps"], metrics["drop"]) == (STEPS, DROP)
    assert metrics["init"] == {"kind": "random", "points": 10_000}
    model = kgs.load_ply(fitted / "splat.ply")
    assert len(model) == metrics["gaussians"]
    assert model.max_sh_degree == 0  # three training views
    config = json.loads((fitted / "config.json").read_text())
    assert (config["fit"]["steps"], config["fit"]["device"]) == (STEPS, "cpu")
    assert config["schedule"]["densify"] == [10, 20]


def test_render_gives_the_pictures_of_fit(fitted, folder, tmp_path):
    assert run("render", fitted / "splat.ply", "--cameras", folder, "-o", tmp_path) == 0
    assert len(list(tmp_path.glob("*.png"))) == 6
    for name in os.listdir(fitted / "test"):
        one, two = (cv2.imread(str(path / name)).astype(int) for path in (tmp_path, fitted / "test"))
        assert np.abs(one - two).max() <= 1


@pytest.fixture
def copied(fitted, tmp_path):
    """The results, for this test alone."""
    shutil.copytree(fitted, tmp_path / "copy")
    return tmp_path / "copy"


def test_eval_measures_the_same_and_keeps_the_rest(copied, capsys):
    path = copied / "metrics.json"
    before = json.loads(path.read_text())
    for values in (before["test"], *before["test"]["views"], before["train"], *before["train"]["views"]):
        values |= {"lpips_vgg": 0.25, "lpips_vgg_unscaled": 0.125}
    before["peak_rss_mb"] = 1
    wrong = json.loads(json.dumps(before))
    wrong["test"]["psnr"] = wrong["train"]["views"][0]["ssim"] = 1.0
    write_json(path, wrong)
    assert run("eval", copied) == 0
    assert json.loads(path.read_text()) == before
    assert "PSNR" in capsys.readouterr().out


def test_eval_refuses_measures_of_other_views(copied, capsys):
    path = copied / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics["test"]["views"][0]["name"] = "another"
    write_json(path, metrics)
    assert run("eval", copied) == 3
    assert ", got others: fit again" in one_line(capsys)
    assert json.loads(path.read_text()) == metrics


def test_a_fit_at_work_is_not_called_unfinished(folder, tmp_path, capsys):
    with Results.open(tmp_path, "fit") as results:
        results.begin()
        results.work.mkdir()
        (results.work / CHECKPOINT).touch()
        assert run("fit", folder, "-o", tmp_path) == 3
        assert "kgs is at work" in one_line(capsys)
    assert run("fit", folder, "-o", tmp_path) == 3
    assert "use --resume, or remove it" in one_line(capsys)


def test_presets_and_details_are_starts_that_options_change(folder, tmp_path, monkeypatch):
    seen = []

    def fit_folder(scene, config, *args, **kwargs):
        seen.append((config, max(scene.train.images.shape[-2:])))
        raise kgs.DataError(folder, "", "no more")

    monkeypatch.setattr("kgs.app.fit_folder.fit_folder", fit_folder)
    low, high = (DETAILS[name].entries for name in ("low", "high"))
    cases = [
        ([], FitConfig()),
        (["--detail", "low"], FitConfig(**low)),
        (["--detail=low", "--steps", 700], FitConfig(**{**low, "steps": 700})),
        (["--detail", "high"], FitConfig(**high)),
        (["--detail", "high", "--init-points", 9, "--size", 40], FitConfig(**{**high, "init_points": 9})),
        (["--steps", 700], FitConfig(steps=700)),
        (["--preset", "paper"], PAPER),
        (["--preset", "paper", "--detail", "low"], replace(PAPER, **low)),
        (["--preset", "paper", "--preset=plain"], PRESETS["plain"]),
        (["--preset=plain", "--preset", "paper"], PAPER),
        (["--detail=low", "--detail", "high", "--detail=normal"], FitConfig()),
    ]
    for options, _ in cases:
        assert run("fit", folder, "-o", tmp_path, *options) == 3
    assert [config for config, _ in seen] == [config for _, config in cases]
    full = seen[0][1]
    assert [size for _, size in seen] == [full, full, full, full, 40, *[full] * 6]  # smaller than any detail's
    assert run("fit", folder, "-o", tmp_path, "--preset=plain", "--sh-degree", 1) == 3
    assert seen[-1][0] == replace(PAPER, drop=0.0, sh_degree=1)
    assert run("fit", folder, "-o", tmp_path, "--preset", "none") == 2
    assert len(seen) == len(cases) + 1


def test_words_after_two_dashes_are_no_options(folder, tmp_path, capsys, monkeypatch):
    (tmp_path / "--help-all").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run("fit", "-o", "out", "--steps", 1, "--", "--help-all") == 3
    assert "--help-all: " in one_line(capsys)
    assert run("fit", "-o", "out", "--steps", 1, "--", "-h") == 3
    assert "-h: expected a file or folder, got none" in one_line(capsys)


def test_versions(capsys, monkeypatch):
    assert run("--version") == 0
    lines = dict(line.split(" ", 1) for line in capsys.readouterr().out.splitlines())
    assert lines["kgs"] == kgs.__version__
    assert {"torch", "kornia", "opencv", "python", "machine"} <= lines.keys()
    monkeypatch.setattr("kgs._support.machine.versions", lambda: {"kgs": "1"})
    assert run("-V") == 0
    assert "numba is not installed" in capsys.readouterr().out


def test_of_an_option_that_is_given_twice_the_last_one_counts(tmp_path):
    kgs.save_ply(tmp_path / "splat.ply", random_model(10, 0))
    assert run("export", tmp_path / "splat.ply", "-o", tmp_path / "a.ply", "--out", tmp_path / "b.ply") == 0
    assert sorted(os.listdir(tmp_path)) == ["b.ply", "splat.ply"]


@pytest.mark.parametrize(("size", "downscale"), [(20, 2.0), (40, 1.0), (9999, 1.0)])
def test_a_size_never_enlarges_photos(folder, size, downscale):
    """Those of the folder have 40 pixels."""
    assert with_size(SceneRequest(str(folder)), SceneSource(folder), size).downscale == downscale


@pytest.mark.parametrize("command", COMMANDS)
def test_each_help_page_says_what_options_do_and_has_two_examples_that_parse(command, capsys):
    words = command.split()
    assert run(*words, "--help") == 0
    said = capsys.readouterr().out
    assert "None" not in said
    described = [line.strip("│ ") for line in said.splitlines() if line.startswith("│")]
    assert not [line for line in described if "--no-" in line and "(default: True)" in line]
    assert f"usage: kgs {command} " in said
    examples = re.findall(rf"^  (?:[A-Z_]+=\S+ )*kgs {command}(|  *.+)$", said, re.M)
    assert len(examples) == 2
    parse = functools.wraps(load_command(command))(lambda *_, **__: None)
    for example in examples:
        options = shlex.split(example)
        config = {"config": first_config(options)} if command == "fit" else {}
        tyro.cli(functools.partial(parse, **config), args=options)


def test_the_help_of_a_fit_is_short_and_its_last_line_names_the_long_one(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    said = {}
    for words in (["--help"], ["--preset", "paper", "-h"], ["--help-all"], ["--preset", "paper", "--help-all"]):
        assert run("fit", *words) == 0
        said[" ".join(words)] = capsys.readouterr().out
    short, whole = said["--help"], said["--help-all"]
    assert len(short.splitlines()) <= 60
    assert max(map(len, short.splitlines())) <= 80
    assert short.splitlines()[-1].startswith("kgs fit --help-all shows all options")
    names = set(re.findall(r"--[a-z][a-z.-]+", short)) - {"--help", "--help-all"}
    assert names >= {"--out", "--views", "--size", "--preset", "--resume", "--steps", "--drop", "--device"}
    assert not {name for name in names if "recipe" in name} | names & {"--coarse", "--max-bytes"}
    assert {"--recipe.lr-means", "--coarse", "--downscale", "--lpips-weights", *names} <= set(
        re.findall(r"--[a-z][a-z.-]+", whole)
    )
    assert "(default: 3)" in said["--preset paper --help-all"]  # of --sh-degree
    for words in (["fit", "--help_all"], ["help", "fit", "--help-all"]):
        assert run(*words) == 0
        assert capsys.readouterr().out == whole
    hidden = ["--recipe.near-plane", "0.1", "--coarse", "2"]  # both are read
    assert run("fit", folder, "-o", tmp_path / "out", *hidden) == 2
    assert "--coarse: expected" in one_line(capsys)


@pytest.mark.parametrize("words", [[], ["--help"], ["bench"], ["bench", "--help"]])
def test_help_without_a_command(words, capsys):
    assert run(*words) == 0
    said = capsys.readouterr().out
    assert "usage: kgs" in said
    assert "speed" in said
    assert ("demo" in said) == ("bench" not in words)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (TrainingDiverged("step 1"), 1, "training diverged: step 1"),
        (MemoryError("allocate"), 1, "not enough memory"),
        (torch.OutOfMemoryError("CUDA out of memory"), 1, "not enough memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), 1, "not enough memory"),
        (RuntimeError("DefaultCPUAllocator: not enough memory: you tried"), 1, "not enough memory"),
        (OSError(errno.ENOSPC, "No space left on device", "/x"), 1, "/x: No space left on device"),
        (ArgumentError("device", "another one", "cpu"), 2, "--device: expected another one, got cpu"),
        (DataError("/x", "", "a file"), 3, "/x: expected a file"),
        (DataError("/x.json", "device", "a list"), 3, "/x.json: device: expected a list"),  # is no option
        (OSError(errno.EACCES, "Permission denied", "/x"), 3, "/x: Permission denied"),
        (PhotosRefused("/x", "", "photos", advice="take more"), 4, "/x: expected photos: take more"),
        (KeyboardInterrupt(), 130, "stopped"),
    ],
)
def test_an_error_is_one_line_and_an_exit_code_by_its_class(error, code, said, monkeypatch, capsys):
    monkeypatch.setattr("kgs.bench.check.check", Mock(side_effect=error))
    assert run("check") == code
    assert one_line(capsys) == f"kgs: {said}" + (f": {error}" if "memory" in said else "")
    assert f"\n| {code} | " in COMMAND_PAGE


@pytest.mark.parametrize(
    "error",
    [
        ValueError("operands could not be broadcast together with shapes (2,) (3,)"),
        ValueError("dim: expected 2, got 3"),  # whatever torch and NumPy say
        TypeError("unexpected keyword"),
        RuntimeError("no kernel image"),
        RuntimeError("failed to allocate a register: out of memory operands"),  # says nothing of this machine's memory
        ImportError("cannot import name", name="kgs.ply"),
    ],
)
def test_a_mistake_in_kgs_is_no_mistake_of_the_user(error, monkeypatch, capsys):
    monkeypatch.setattr("kgs.bench.check.check", Mock(side_effect=error))
    assert run("check") == 70
    *trace, before, last = capsys.readouterr().err.splitlines()
    assert trace[0].startswith("Traceback")
    assert before == f"{type(error).__name__}: {error}"
    assert last.startswith("kgs: this is a mistake in kgs: please report it")
    assert "\n| 70 | " in COMMAND_PAGE


def test_a_fit_says_what_to_do_next_and_warns_in_one_line_without_code(folder, tmp_path, capsys):
    assert run("fit", folder, "-o", tmp_path, "--steps", 1, "--init", "sift", "--init-points", 30) == 0
    said = capsys.readouterr()
    (line,) = (line for line in said.err.splitlines() if "SIFT" in line)
    assert line.startswith("kgs: initial points: SIFT found")
    assert "\r" not in said.err  # without a terminal
    assert "WEIGHTS" not in said.out
    assert f"next: open {tmp_path / 'index.html'} in a browser" in said.out
    assert len(said.out.splitlines()) <= 10  # without a terminal


def test_quiet_says_nothing_and_open_shows_the_page(folder, tmp_path, capsys, monkeypatch):
    opened = Mock(return_value=True)
    monkeypatch.setattr("kgs.app.console.webbrowser.open", opened)
    quick = ("--steps", 1, "--init", "random", "--init-points", 30)
    assert run("fit", folder, "-o", tmp_path, *quick, "--open", "-q") == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""
    opened.assert_called_once_with((tmp_path / "index.html").as_uri())


def test_a_package_that_cannot_be_loaded_is_one_line(tmp_path, capsys, monkeypatch):
    """As a shared library that it lacks leaves it."""
    home, photos = tmp_path / "broken" / "jinja2", tmp_path / "photos"
    home.mkdir(parents=True)
    (home / "__init__.py").write_text("from .core import x")
    (home / "core.py").write_text("raise ImportError('libx.so.1: cannot open shared object file\\nSee the manual.')")
    photos.mkdir()
    for i in range(3):
        cv2.imwrite(str(photos / f"{i}.png"), np.full((20, 20, 3), i, np.uint8))
    for name in [name for name in sys.modules if name.partition(".")[0] == "jinja2"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(home.parent)
    monkeypatch.setattr("importlib.metadata.packages_distributions", dict)
    assert run("fit", photos, "-o", tmp_path / "out") == 1
    said = "jinja2 is installed, but cannot be loaded (libx.so.1: cannot open shared object file): run pip install"
    assert one_line(capsys) == f"kgs: {said} --force-reinstall jinja2 (of the extra app)"
    assert not (tmp_path / "out").exists()


def test_a_large_package_that_cannot_be_loaded(monkeypatch):
    def broken(name):
        if name in bad:
            raise OSError("libcudart.so.12: cannot open shared object file")  # torch loads its libraries itself

    bad = ["torch"]
    monkeypatch.setattr("kgs.app.cli.tools.import_module", broken)
    with pytest.raises(ImportError, match="libcudart") as caught:
        load_package("torch")
    assert "torch is installed, but cannot be loaded (libcudart" in explain_import_error(caught.value)
    bad = ["numba"]
    assert load_tools().type == "cpu"  # torch may do in its place
    assert explain_import_error(ImportError("of ours", name="kgs._support.errors")) == ""
