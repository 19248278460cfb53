"""The command `kgs` and what it writes to: pipes, closed streams, names that a terminal cannot show."""

import io
import os
import signal
import subprocess
import sys
import time

import pytest

from kgs.cli import main

MAIN = "import kgs.cli; kgs.cli.main()"


def kgs_process(*arguments, shell):
    command = ["bash", "-c", f'"$@" {shell}', "bash", sys.executable, "-c", MAIN, *map(str, arguments)]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": ""}
    return subprocess.run(command, capture_output=True, timeout=200, env=env)


FIT = ("--init", "random", "--init-points", 50, "--steps", 12)
RESULTS = {"index.html", "splat.ply", "metrics.json", "config.json", "curve.png", "test"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "shell",
    ["<&- >&- 2>&-", "2>&1 | head -1", "> /dev/full 2>&1"],
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


WITHOUT_TORCH = """
import sys

class NoTorch:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "numpy", "cv2", "kornia"):
            sys.exit(f"{name} is imported")

sys.meta_path.insert(0, NoTorch)
import kgs.cli
kgs.cli.main()
"""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fti"], "did you mean fit?"),
        (["fit", "missing", "-o", "out"], "kgs: missing: expected"),
        (["fit", ".", "-o", "out", "--stpes", "3"], "--steps"),
        (["fit", ".", "-o", "out", "--steps", "many"], "--steps"),
        (["eval", "missing"], "kgs: missing: expected"),
        (["render", "missing", "--cameras", ".", "-o", "out"], "kgs: missing: expected"),
        (["study", "-o", "out", "--lpips-weights", "missing"], "kgs: missing: expected"),
    ],
)
def test_mistakes_are_told_before_torch_is_loaded(tmp_path, words, said):
    command = [sys.executable, "-c", WITHOUT_TORCH, *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert said in done.stderr
    assert os.listdir(tmp_path) == []


SLOW_TORCH = """
import sys, time

class SlowTorch:
    def find_spec(name, path=None, target=None):
        if name == "torch":
            print("torch", flush=True)
            try:
                time.sleep(60)
            except BaseException:
                pass  # as code does that is called while modules are imported

sys.meta_path.insert(0, SlowTorch)
import kgs.cli
kgs.cli.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_while_torch_is_imported_is_quiet(tmp_path):
    command = [sys.executable, "-c", SLOW_TORCH, "fit", ".", "-o", "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as process:
        assert process.stdout.readline() == b"torch\n"
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr.read() == b""


def test_ctrl_c_raises_as_usual_after_a_command():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(SystemExit):
        main(["nonsense"])
    assert signal.getsignal(signal.SIGINT) is before
