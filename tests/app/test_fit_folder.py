"""The folder of a fit: one fit at a time, and old results that stay whole until the new ones are."""

from __future__ import annotations

import json
import os
import shutil
import signal
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from fits_in_folders import fit_in

from kgs._support.errors import DataError, TrainingDiverged
from kgs.app import fit_folder as app
from kgs.app.cli.evaluate import evaluate
from kgs.app.files.fit_files import CHECKPOINT, UNFINISHED
from kgs.app.files.results import Results, read_marker
from kgs.app.saved_fit import load_fit
from kgs.app.scene_request import SceneRequest
from kgs.datasets.synthetic import synthetic_scene
from kgs.fit import measures
from kgs.fit import trainer as trainer_module
from kgs.fit.checkpoint import load_checkpoint, previous, save_checkpoint
from kgs.fit.config import DROP, FitConfig, Recipe
from kgs.fit.pruning import prune
from kgs.fit.trainer import Trainer

CONFIG = FitConfig(steps=3, evaluations=1, max_gaussians=300, sh_degree=1, recipe=Recipe(grad_threshold=1e-5))
OTHER = replace(CONFIG, seed=1)


@pytest.fixture(scope="module", autouse=True)
def _few_points(scene: Any, points: Any) -> Any:
    """The same initial points; and every folder's scene is the one of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgs.fit.run.choose_points", lambda *_: points)
        patch.setattr(SceneRequest, "load", lambda *_: scene)
        yield


@pytest.fixture(scope="module")
def first_fit(scene: Any, tmp_path_factory: Any) -> Path:
    out: Path = tmp_path_factory.mktemp("first")
    fit(scene, CONFIG, out)
    return out


@pytest.fixture
def done(first_fit: Path, tmp_path: Path) -> Path:
    """A folder with the finished fit of CONFIG, for this test alone."""
    shutil.copytree(first_fit, tmp_path, dirs_exist_ok=True)
    return tmp_path


def fit(scene: Any, config: FitConfig, out: Path, **options: Any) -> list[str]:
    """Fit; the lines that were said, unless something else listens."""
    lines: list[str] = []
    fit_in(scene, config, out, SceneRequest("/photos", 3), **{"say": lines.append} | options)
    return lines


def contents(out: Path) -> dict[str, bytes]:
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def full(path: Any, *_: Any, **__: Any) -> Any:
    """Stands in for a write on a full disk."""
    raise OSError(28, "No space left on device", str(path))


def seed_of(out: Path) -> int:
    """The seed of the set of files, the same in all of them."""
    config = json.loads((out / "config.json").read_text())
    metrics = json.loads((out / "metrics.json").read_text())
    assert config["fit"]["seed"] == metrics["seed"] == load_checkpoint(out / CHECKPOINT)["config"]["seed"]
    assert len(load_fit(out)[1].model) == metrics["gaussians"]
    return int(metrics["seed"])


def test_a_fit_that_fails_at_once_changes_nothing(scene: Any, done: Path, monkeypatch: Any) -> None:
    before = contents(done)
    monkeypatch.setattr("kgs.fit.trainer.gradient_fault", lambda model: "expected finite gradients")
    with pytest.raises(TrainingDiverged, match="step 1.*no checkpoint yet"):
        fit(scene, OTHER, done)
    assert contents(done) == before


def test_results_that_cannot_be_written_leave_the_old_ones(scene: Any, done: Path, monkeypatch: Any) -> None:
    """And the training is not lost: each fit goes on with the results that the one before could not write."""
    for failing in ("save_ply", "write_png", "write_json"):
        plain = getattr(app, failing)

        def failed(path: Any, *arguments: Any, failing: str = failing, plain: Any = plain, **options: Any) -> Any:
            if failing == "write_json" and path.name != "metrics.json":
                return plain(path, *arguments, **options)
            return full(path)

        with monkeypatch.context() as patch:
            patch.setattr(app, failing, failed)
            with pytest.raises(OSError, match="space"):
                fit(scene, OTHER, done, resume=failing != "save_ply")
        assert seed_of(done) == 0, failing
    assert fit(scene, OTHER, done, resume=True)[0] == "resumed at step 3"
    assert seed_of(done) == 1


def test_results_of_a_full_disk_are_kept_where_no_checkpoint_could_be_written(
    scene: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    """The disk fills up during the training: splat and curve still fit on it, the first test picture does not."""
    monkeypatch.setattr(Trainer, "save", full)
    monkeypatch.setattr(app, "write_png", full)
    lines: list[str] = []
    with pytest.raises(OSError, match="space") as error:
        fit(scene, CONFIG, tmp_path, say=lines.append)
    held = tmp_path / UNFINISHED
    assert error.value.filename == str(held / "test" / "test_00.png")
    assert {"splat.ply", "curve.png", "cameras.json"} <= set(os.listdir(held))
    assert f"{held}: holds the results that could be written" in lines


@pytest.mark.slow
@pytest.mark.parametrize("failures", [2, 3])  # of the evaluation's, the last one, and the second try of that
def test_a_fit_is_finished_only_with_the_checkpoint_of_its_last_step(
    scene: Any, done: Path, monkeypatch: Any, failures: int
) -> None:
    """What it shows and what is evaluated later would differ; the last checkpoint is tried again at the end."""
    plain = trainer_module.save_checkpoint
    left = iter(range(failures))

    def full_at_the_end(path: Path, state: dict[str, Any]) -> None:
        if state["step"] == 3 and next(left, None) is not None:
            full(path)
        plain(path, state)

    monkeypatch.setattr(trainer_module, "save_checkpoint", full_at_the_end)
    with nullcontext() if failures == 2 else pytest.raises(OSError, match="No space"):
        fit(scene, OTHER, done)
    assert seed_of(done) == (failures == 2)
    assert load_checkpoint(done / CHECKPOINT)["step"] == 3


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"near_plane": -1.0}, "near_plane"),
        ({"near_plane": "near"}, "near_plane"),
        ({"step": -5}, "step"),
        ({"backend": "foo"}, "backend"),
        ({"poses": {"extrinsics": [1.0]}}, "poses"),
        ({"poses": "none"}, "poses"),
    ],
)
def test_a_forged_checkpoint_is_refused(done: Path, changes: dict[str, Any], field: str) -> None:
    path = done / CHECKPOINT
    save_checkpoint(path, load_checkpoint(path) | changes)
    previous(path).unlink(missing_ok=True)
    with pytest.raises(DataError) as error:
        load_fit(done)
    assert (error.value.path, error.value.key) == (path, field)


def folders(out: Path) -> list[str]:
    return sorted(path.name for path in out.iterdir() if path.is_dir())


def stop(*_: str) -> None:
    """Stands in for the end of the process."""
    raise KeyboardInterrupt


@pytest.mark.parametrize("are_of_this_fit", [True, False])
def test_cameras_that_waited_for_a_fit_come_with_it(
    scene: Any, done: Path, monkeypatch: Any, are_of_this_fit: bool
) -> None:
    """After a kill, too: a fit never shows itself beside the cameras of another one."""
    photos = done / UNFINISHED
    photos.mkdir()
    (photos / "photos.json").write_text("{}")
    scene = replace(scene, root=photos if are_of_this_fit else Path("/photos"))
    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(Results, "publish", stop)  # all results are there, none is in its place
        fit(scene, OTHER, done)
    assert not (done / "photos.json").exists()
    assert seed_of(done) == 0
    assert fit(scene, OTHER, done, resume=True)[0] == "resumed at step 3"
    assert seed_of(done) == 1
    assert (done / "photos.json").exists() == ("photos" in read_marker(done)) == are_of_this_fit
    assert folders(done) == ["test"]


def test_eval_does_not_pass_off_the_checkpoint_of_another_step(scene: Any, done: Path) -> None:
    fit(scene, replace(CONFIG, steps=5), done, resume=True)
    (done / CHECKPOINT).write_bytes(b"damaged")
    state = load_checkpoint(previous(done / CHECKPOINT))
    lines: list[str] = []
    load_fit(done, say=lines.append)
    assert "the previous checkpoint is used" in lines[0]
    save_checkpoint(done / CHECKPOINT, state | {"step": 4})
    with pytest.raises(DataError, match="step: expected that of metrics.json, 5, got 4"):
        load_fit(done)


def test_eval_says_how_to_go_on_with_a_fit_that_was_killed(tmp_path: Path) -> None:
    (tmp_path / UNFINISHED).mkdir()
    (tmp_path / UNFINISHED / CHECKPOINT).touch()
    with pytest.raises(DataError, match="kgs fit --resume"):
        evaluate(tmp_path)


def test_an_unfinished_fit_is_gone_on_with_or_the_next_one_is_refused(scene: Any, done: Path, monkeypatch: Any) -> None:
    """Nobody's training is lost: whoever wants none of it removes the folder."""
    interrupt_at(1, monkeypatch)
    lines = fit(scene, OTHER, done)
    assert any("keeps its finished fit, until this one is done; to go on with it, use --resume" in x for x in lines)
    work = done / UNFINISHED
    assert f"{done} keeps its finished fit; this one is in {work}" in lines[-1]
    assert (seed_of(done), seed_of(work)) == (0, 1)
    assert (work / "index.html").exists()
    monkeypatch.undo()
    before = contents(done)
    with pytest.raises(DataError, match="use --resume, or remove") as error:
        fit(scene, OTHER, done)
    assert error.value.path == work
    with pytest.raises(DataError, match="seed: expected 1") as error:  # also with the settings of the finished one
        fit(scene, CONFIG, done, resume=True)
    assert error.value.path == work / CHECKPOINT
    assert contents(done) == before
    assert fit(scene, OTHER, done, resume=True)[0] == "resumed at step 2"
    assert seed_of(done) == 1
    assert folders(done) == ["test"]


def interrupt_at(step: int, patch: Any) -> None:
    """The process gets SIGINT as this step begins."""
    plain = Trainer._optimize

    def interrupted(self: Trainer) -> float:
        if self.step == step:
            os.kill(os.getpid(), signal.SIGINT)
        return plain(self)

    patch.setattr(Trainer, "_optimize", interrupted)


@pytest.mark.parametrize(("decided", "interrupted"), [(2, False), (6, True)])
def test_a_fit_is_done_after_the_steps_that_the_photos_decided(
    scene: Any, done: Path, monkeypatch: Any, decided: int, interrupted: bool
) -> None:
    monkeypatch.setattr("kgs.fit.plan.decide_by_overlap", lambda *_: (decided, DROP, None))
    if interrupted:
        interrupt_at(3, monkeypatch)
    fit(scene, OTHER, done)
    assert seed_of(done) == (0 if interrupted else 1)
    assert folders(done) == (["test", UNFINISHED] if interrupted else ["test"])


def test_what_got_further_is_kept_until_one_is_further_or_done(scene: Any, tmp_path: Path, monkeypatch: Any) -> None:
    """Stopped at step 4 of 7, again from the beginning at step 2, then resumed: at step 5, and never."""
    config = replace(CONFIG, steps=7)
    for stop, resume, published, unfinished in (
        (4, False, 4, []),
        (2, False, 4, [UNFINISHED]),
        (5, True, 5, []),
    ):
        with monkeypatch.context() as patch:
            interrupt_at(stop - 1, patch)
            fit(scene, config, tmp_path, resume=resume)
        assert load_checkpoint(tmp_path / CHECKPOINT)["step"] == published
        assert folders(tmp_path) == ["test", *unfinished]
        assert seed_of(tmp_path) == 0
    assert fit(scene, config, tmp_path, resume=True)[0] == "resumed at step 5"
    assert folders(tmp_path) == ["test"]
    assert load_checkpoint(tmp_path / CHECKPOINT)["step"] == 7


def test_results_without_a_checkpoint_are_kept_until_one_is_further(
    scene: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    config = replace(CONFIG, steps=7)
    for stop in (4, 2):
        with monkeypatch.context() as patch:
            interrupt_at(stop - 1, patch)
            fit(scene, config, tmp_path)
        for name in (CHECKPOINT, previous(Path(CHECKPOINT)).name):
            (tmp_path / name).unlink(missing_ok=True)
    assert json.loads((tmp_path / "metrics.json").read_text())["steps"] == 4
    assert folders(tmp_path) == ["test", UNFINISHED]


@pytest.mark.slow
def test_images_that_are_too_small_are_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected at least 6x6 pixels, got 5x5"):
        fit(synthetic_scene(train_views=2, size=(5, 5)), CONFIG, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_loaded_fit_is_the_one_that_was_saved(scene: Any, tmp_path: Path) -> None:
    made = fit_in(scene, CONFIG, tmp_path, SceneRequest("/photos", 3), say=lambda _: None).fit
    request, saved = load_fit(tmp_path)
    assert request == SceneRequest("/photos", 3)
    assert (
        json.loads((tmp_path / "config.json").read_text())["fit"]["backend"] == "auto"
    )  # saved.backend is what it was
    for name in ("options", "backend", "settings", "decisions", "notes"):
        assert getattr(saved, name) == getattr(made, name), name
    assert saved.decisions.gaussians is not None
    for name in ("history", "metrics"):
        assert getattr(saved, name) == json.loads(json.dumps(getattr(made, name))), name
    assert (saved.part["sh_degree"], saved.part["rows"].tolist()) == (
        made.part["sh_degree"],
        made.part["rows"].tolist(),
    )
    camera = scene.test.camera(0)
    assert torch.equal(saved.render(camera), made.render(camera))
    trainer = Trainer.resume(scene, CONFIG, tmp_path / CHECKPOINT)
    assert torch.equal(saved.render(camera), prune(trainer.result()).render(camera))
    assert measures.measure(saved)["test"] == saved.metrics["test"]
