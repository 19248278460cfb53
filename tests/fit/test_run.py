"""Long runs: signals, disks without room, checkpoints by the clock; the loop is the trainer's own."""

import os
import shutil
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from fits_in_folders import fit_in

from kgs._support.errors import DataError
from kgs.app.files.fit_files import CHECKPOINT
from kgs.app.scene_request import SceneRequest
from kgs.app.training import Training
from kgs.fit.checkpoint import load_checkpoint, previous
from kgs.fit.config import FitConfig, Recipe
from kgs.fit.trainer import Trainer

CONFIG = FitConfig(steps=12, evaluations=4, max_gaussians=300, recipe=Recipe(grad_threshold=1e-5))


@pytest.fixture(scope="module", autouse=True)
def _few_points(points):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgs.fit.run.choose_points", lambda *_: points)
        yield


def fit_folder(scene, config, out, lines=None, **options):
    """Fit; the lines that are said are added to `lines`."""
    say = ([] if lines is None else lines).append
    return fit_in(scene, config, out, SceneRequest("/photos"), say=say, **options)


@pytest.fixture(scope="module")
def whole(scene, tmp_path_factory):
    """The folder of a fit that nothing disturbed."""
    out: Path = tmp_path_factory.mktemp("whole")
    fit_folder(scene, CONFIG, out)
    return out


def train(scene, path, disturb=lambda _: None):
    """A training whose trainer is disturbed as it begins."""
    training = Training(path, begun=disturb)
    training.fit(scene, CONFIG)
    return training


def at_step(trainer, step, act):
    """Do something in the middle of a step."""
    plain = trainer._optimize

    def descend():
        loss = plain()
        if trainer.step == step:
            act()
        return loss

    trainer._optimize = descend  # type: ignore[method-assign]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_step_and_saves(scene, tmp_path, number):
    handler = signal.getsignal(number)
    disturb = partial(at_step, step=9, act=lambda: os.kill(os.getpid(), number))
    training = train(scene, tmp_path / CHECKPOINT, disturb)
    assert training.signal == number
    assert load_checkpoint(tmp_path / CHECKPOINT)["step"] == training.trainer.step == 9
    assert signal.getsignal(number) == handler


def test_a_second_signal_acts_at_once(scene, tmp_path):
    def twice():
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(scene, tmp_path / CHECKPOINT, partial(at_step, step=9, act=twice))
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler


def test_an_interrupted_fit_writes_its_results_and_goes_on(scene, whole, tmp_path, monkeypatch):
    plain = Trainer.__init__

    def interrupted(self, *arguments):
        plain(self, *arguments)
        at_step(self, 10, lambda: os.kill(os.getpid(), signal.SIGTERM))

    monkeypatch.setattr(Trainer, "__init__", interrupted)
    cut = fit_folder(scene, CONFIG, tmp_path)
    assert (cut.fit.metrics["steps"], cut.signal, cut.folder) == (10, signal.SIGTERM, tmp_path)
    assert (tmp_path / "splat.ply").is_file()
    ended = fit_folder(scene, CONFIG, tmp_path, resume=True)
    assert (ended.fit.metrics["steps"], ended.signal) == (12, 0)
    assert (tmp_path / "splat.ply").read_bytes() == (whole / "splat.ply").read_bytes()


@pytest.mark.parametrize("steps", [(3, 9), range(1, 12)])  # by the evaluations, and by the clock
def test_a_full_disk_is_one_note_and_the_next_checkpoint_is_tried(scene, tmp_path, monkeypatch, steps):
    plain, failed = os.fsync, []
    training = Training(tmp_path / CHECKPOINT)
    if len(steps) > 2:
        monkeypatch.setattr("kgs.app.training._SAVE_SECONDS", 0.0)

    def full(descriptor):
        if training.trainer.step in steps:
            failed.append(training.trainer.step)
            raise OSError(28, "No space left on device")
        plain(descriptor)

    monkeypatch.setattr("os.fsync", full)
    trainer, _ = training.fit(scene, CONFIG)
    assert failed == [*steps]
    (note,) = trainer.state.notes
    assert note.startswith(f"step {steps[0]}: no checkpoint: ")
    assert CHECKPOINT in note
    values = load_checkpoint(tmp_path / CHECKPOINT)
    assert (values["step"], values["notes"]) == (12, [note])
    assert len(steps) > 2 or sorted(p.name for p in tmp_path.iterdir()) == [previous(Path(CHECKPOINT)).name, CHECKPOINT]


def test_a_damaged_checkpoint_falls_back_and_ends_in_the_same_bits(scene, whole, tmp_path):
    lines: list[str] = []
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-7])
    fit_folder(scene, CONFIG, tmp_path, resume=True, lines=lines)
    assert any("went on from the previous checkpoint" in line for line in lines)
    assert (tmp_path / "splat.ply").read_bytes() == (whole / "splat.ply").read_bytes()
    path.write_bytes(path.read_bytes()[:-7])
    Trainer.resume(scene, CONFIG, path)  # the whole one is not lost when the next is written
    assert load_checkpoint(path)["step"] > 0
    assert not previous(path).exists()
    for damaged in (path, previous(path)):
        damaged.write_bytes(b"")
    with pytest.raises(DataError, match=CHECKPOINT):
        Trainer.resume(scene, CONFIG, path)


def test_stages_memory_and_what_is_not_resumed_are_told(scene, tmp_path):
    short = replace(CONFIG, steps=2)
    lines: list[str] = []
    fit_folder(scene, short, tmp_path, lines, resume=True)
    nothing = f"{tmp_path}: there is nothing to resume: the fit starts at the beginning"
    assert nothing in lines
    stages = ["1 of 4: initial points", "2 of 4: fit", "3 of 4: film", "4 of 4: page"]
    assert [line for line in lines if " of 4: " in line] == stages
    (memory,) = [line for line in lines if line.endswith(" GiB of memory")]
    assert lines.index(stages[0]) < lines.index(memory) < lines.index(stages[1])
    lines.clear()
    fit_folder(scene, short, tmp_path, lines, resume=True)
    assert nothing not in lines
    assert [line for line in lines if " of 4: " in line] == stages[1:]
    fit_folder(scene, replace(short, seed=1), tmp_path)
    assert load_checkpoint(previous(tmp_path / CHECKPOINT))["config"]["seed"] == 1  # nothing of the former fit


def test_a_signal_that_is_ignored_stays_so(scene, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        disturb = partial(at_step, step=3, act=lambda: os.kill(os.getpid(), signal.SIGHUP))
        training = train(scene, tmp_path / CHECKPOINT, disturb)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert (training.signal, training.trainer.step) == (0, 12)
