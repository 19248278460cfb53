"""What a fit survives: kill -9 at random moments, SIGTERM, a full disk; and its memory over many steps.

A fit that was killed and resumed, however often, must end in the very bits of one that was left alone.
"""

from __future__ import annotations

import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

if sys.platform != "linux":
    pytest.skip("limits and signals of POSIX, memory from /proc", allow_module_level=True)

from fits import PATIENCE, Fit, memory_of, start_command

from kgs._support.errors import DataError
from kgs.app.files.fit_files import CHECKPOINT, UNFINISHED
from kgs.fit.checkpoint import load_checkpoint, newest_checkpoint

STEPS = 450


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """What splat.ply of a fit holds that is left alone."""
    return Fit(tmp_path_factory.mktemp("alone"), "alone", STEPS).finish()


@pytest.fixture
def record(record_property: Callable[[str, object], None]) -> Callable[..., None]:
    """Leaves a row of the table, then fails where it has to."""

    def note(fault: str, trials: int, lost: int, found: str, met: bool) -> None:
        verdict = "met" if met else "FAILED"
        row = {"name": fault, "trials": trials, "lost": lost, "found": found, "verdict": verdict}
        record_property("faults", row)
        assert met, found

    return note


def _bits(same: bool) -> str:
    return "the same bits" if same else "other bits"


@pytest.mark.slow  # test_study_grid.py kills a grid, test_run.py damages checkpoints
def test_kill_9_at_random_moments(alone: bytes, tmp_path: Path, record: Callable[..., None]) -> None:
    """One fit after the other, killed again and again, each time resumed from what it left."""
    trials, longest = 30, 0.6
    fit, moments = Fit(tmp_path, "killed", STEPS), random.Random(0)
    path, corrupt, fallen_back, different, fits, kills = fit.out / UNFINISHED / CHECKPOINT, 0, 0, 0, 0, 0
    while kills < trials:
        process = fit.start()
        if fit.wait_for_steps(process):
            time.sleep(moments.uniform(0.0, longest))
            process.kill()
        process.join(PATIENCE)
        kills += process.exitcode == -signal.SIGKILL and path.exists()
        longest = 0.7 * longest if process.exitcode == 0 else longest  # this machine is faster
        if process.exitcode == 0:  # it was done before
            different += (fit.out / "splat.ply").read_bytes() != alone
            fits += 1
            shutil.rmtree(fit.out)
            continue
        if not any(path.parent.glob(f"{path.stem}*{path.suffix}")):
            continue
        try:
            load_checkpoint(path)
        except DataError:
            fallen_back += 1
        try:
            newest_checkpoint(path)
        except DataError:
            corrupt += 1
    different += fit.finish() != alone
    found = f"{fallen_back} times the previous checkpoint, {fits + 1} fits ended, {different} of them in other bits"
    record("kill -9 at a random moment", trials, corrupt, found, corrupt == different == 0)


@pytest.fixture(scope="module")
def fitted(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a fit of the scene `folder`."""
    out = tmp_path_factory.mktemp("fitted") / "out"
    few = ("--steps", 12, "--init", "random", "--init-points", 200)
    process = start_command("fit", folder, "-o", out, *few)
    process.join(PATIENCE)
    assert process.exitcode == 0
    return out


# A command, and a file that it writes; SCENE and OUT are folders.
COMMANDS = {
    "fit": ("fit SCENE -o OUT --steps 12 --init random --init-points 200", "splat.ply"),
    "eval": ("eval OUT", "metrics.json"),
    "page": ("page OUT -o OUT/more/a.html", "more/a.html"),
    "clean": ("clean OUT -o OUT/more/clean.ply", "more/clean.ply"),
    "scale": ("scale OUT --by 0,0,0 0,0,1 2 -o OUT/more", "more/splat.ply"),
    "export": ("export OUT -o OUT/more/a.compressed.ply", "more/a.compressed.ply"),
    "render": ("render OUT -o OUT/more", "more/train_r_0.png"),
    "demo": ("demo -o OUT/more --steps 3 --size 32", "more/splat.ply"),
}
MINE = ("notes.txt", "test/notes.txt", "images/IMG_1.jpg")


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_kill_9_of_each_command(
    command: str, folder: Path, fitted: Path, tmp_path: Path, record: Callable[..., None]
) -> None:
    """Killed at a random moment, then run again: all results are there, and all files of the user."""
    line, name = COMMANDS[command]
    trials = 30
    moments = random.Random(0)
    seconds = 0.0
    lost = 0
    whole = b""
    for trial in range(trials + 1):
        out = tmp_path / str(trial)
        shutil.copytree(fitted, out)
        (out / "more").mkdir()
        for mine in MINE:
            (out / mine).parent.mkdir(exist_ok=True)
            (out / mine).write_text("mine")
        words = [word.replace("SCENE", str(folder)).replace("OUT", str(out)) for word in line.split()]
        start = time.monotonic()
        if trial:  # the first one is left alone
            process = start_command(*words)
            time.sleep(moments.uniform(0.0, seconds))
            process.kill()
            process.join(PATIENCE)
        again = [*words, "--resume"] if command in ("fit", "demo") and trial else words
        process = start_command(*again)
        process.join(PATIENCE)
        seconds = seconds or time.monotonic() - start
        written = (out / name).read_bytes() if (out / name).is_file() else b""
        whole = whole or written
        same = written == whole or name.endswith((".html", ".json"))  # they have times
        lost += process.exitcode != 0 or not written or not same
        lost += any((out / mine).read_text() != "mine" for mine in MINE)
        lost += any(path.is_dir() and path.name.startswith((".kgs-", UNFINISHED)) for path in out.rglob("*"))
        shutil.rmtree(out)
    found = f"{lost} times a file of the user lost, or a result, or a folder left"
    record(f"kill -9 of kgs {command}", trials, lost, found, lost == 0)


@pytest.mark.slow  # test_run.py has the signals in one process
def test_sigterm(alone: bytes, tmp_path: Path, record: Callable[..., None]) -> None:
    fit = Fit(tmp_path, "terminated", STEPS)
    process = fit.start()
    running = fit.wait_for_steps(process)
    process.terminate()
    process.join(PATIENCE)
    code, written = process.exitcode, (fit.out / "metrics.json").exists()
    same = fit.finish() == alone
    found = f"exit code {code}, results {'' if written else 'not '}written; resumed: {_bits(same)}"
    record("SIGTERM", 1, int(not same), found, running and written and same and code == 128 + signal.SIGTERM)


@pytest.mark.slow
def test_full_disk(alone: bytes, tmp_path: Path, record: Callable[..., None]) -> None:
    """From some step on no file may grow beyond 16 KiB: neither checkpoints nor results can be written."""
    fit = Fit(tmp_path, "full", STEPS)
    process = fit.start(limit=2**14)
    process.join(PATIENCE)
    code = process.exitcode
    try:
        step = newest_checkpoint(fit.out / UNFINISHED / CHECKPOINT)[0]["step"]
    except DataError:
        step = -1
    partial = [path.name for path in fit.out.rglob("*.partial")]
    same = fit.finish() == alone
    found = f"the checkpoint of step {step} is whole, {len(partial)} partial files; resumed: {_bits(same)}"
    record("full disk", 1, int(step < 0), found, code != 0 and step > 0 and not partial and same)


@pytest.mark.slow
def test_memory_over_many_steps(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    steps = 2000
    slope, peak, ceiling = memory_of(tmp_path, steps)
    growth = f"grows by {slope:+.2f} KiB per step over the second half"
    maximum = f"at most {peak / 2**20:.0f} MiB over the start, {ceiling / 2**20:.0f} MiB estimated"
    rows = [("memory", growth, slope < 1.0), ("memory ceiling", maximum, peak <= ceiling)]
    for fault, found, met in rows:
        row = {"name": f"{fault}, {steps} steps", "trials": 1, "lost": 0, "found": found}
        record_property("faults", {**row, "verdict": "met" if met else "FAILED"})
    assert [found for _, found, met in rows if not met] == []
