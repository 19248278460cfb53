"""The command `kgs` and what it writes to: pipes, closed streams, names that a terminal cannot show."""

import io
import os
import subprocess
import sys

import pytest

from kgs.cli import main

MAIN = "import kgs.cli; kgs.cli.main()"


def kgs_process(*arguments, shell):
    command = ["bash", "-c", f'"$@" {shell}', "bash", sys.executable, "-c", MAIN, *map(str, arguments)]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": ""}
    return subprocess.run(command, capture_output=True, timeout=200, env=env)


FIT = ("--init", "random", "--init-points", 50, "--steps", 12)
RESULTS = {"index.html", "splat.ply", "metrics.json", "config.json", "curve.png", "test"}


@pytest.mark.parametrize(
    "shell",
    ["<&- >&- 2>&-", *(pytest.param(ways, marks=pytest.mark.slow) for ways in ("2>&1 | head -1", "> /dev/full 2>&1"))],
)
def test_results_are_written_whoever_listens(folder, tmp_path, shell):
    done = kgs_process("fit", folder, "-o", tmp_path / "out", *FIT, shell=f"{shell}; exit ${{PIPESTATUS[0]}}")
    assert done.returncode == 0, done.stderr.decode()
    assert set(os.listdir(tmp_path / "out")) >= RESULTS
    assert b"Traceback" not in done.stderr
    assert b"BrokenPipe" not in done.stderr


def fit_here(folder, out, monkeypatch, *streams):
    """A fit in this process that writes to these streams: its exit code."""
    for name, stream in zip(("stdout", "stderr"), streams, strict=True):
        monkeypatch.setattr(sys, name, stream)
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(folder), "-o", str(out), *map(str, FIT)])
    monkeypatch.undo()
    return stop.value.code


@pytest.mark.parametrize("listener", ["gone", "full"])
def test_results_are_written_where_nothing_can_be_said(folder, tmp_path, monkeypatch, listener):
    """As with `| head -1` and on a full disk, without the time of another process."""

    def stream():
        if listener == "full":
            return open("/dev/full", "w")
        read, write = os.pipe()
        os.close(read)
        return open(write, "w")

    streams = [stream(), stream()]
    assert fit_here(folder, tmp_path / "out", monkeypatch, *streams) == 0
    assert set(os.listdir(tmp_path / "out")) >= RESULTS
    for each in streams:
        each.close()  # as at exit: nothing is left that could not be written


def test_a_name_that_the_terminal_cannot_show(folder, tmp_path, monkeypatch):
    out = tmp_path / "ünï \n 漢字 'quoted'"
    said = [io.BytesIO(), io.BytesIO()]
    streams = [io.TextIOWrapper(said[0], "ascii"), io.TextIOWrapper(said[1], "ascii", "backslashreplace")]
    assert fit_here(folder, out, monkeypatch, *streams) == 0, said[1].getvalue()
    assert set(os.listdir(out)) >= RESULTS


def test_help_for_head():
    done = kgs_process("fit", "--help", shell="| head -1; exit ${PIPESTATUS[0]}")
    assert (done.returncode, done.stderr) == (0, b"")
