"""The command `kgs` as a process: pipes, closed streams, names that a terminal cannot show."""

import os
import subprocess
import sys

import pytest

MAIN = "import kgs.cli; kgs.cli.main()"


def kgs_process(*arguments, before="", shell="", **options):
    command = [sys.executable, "-c", f"{before}\n{MAIN}", *map(str, arguments)]
    if shell:
        command = ["bash", "-c", f'"$@" {shell}', "bash", *command]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "", **options.pop("env", {})}
    return subprocess.run(command, capture_output=True, timeout=200, env=env, **options)


FIT = ("--init", "random", "--init-points", 50, "--steps", 12)
RESULTS = {"splat.ply", "metrics.json", "config.json", "curve.png", "test"}


@pytest.mark.parametrize("shell", ["2>&1 | head -1", "<&- >&- 2>&-", "> /dev/full 2>&1"])
def test_results_are_written_whoever_listens(folder, tmp_path, shell):
    done = kgs_process("fit", folder, "-o", tmp_path / "out", *FIT, shell=f"{shell}; exit ${{PIPESTATUS[0]}}")
    assert done.returncode == 0, done.stderr.decode()
    assert set(os.listdir(tmp_path / "out")) >= RESULTS
    assert b"Traceback" not in done.stderr
    assert b"BrokenPipe" not in done.stderr


def test_a_name_that_the_terminal_cannot_show(folder, tmp_path):
    out = tmp_path / "ünï \n 漢字 'quoted'"
    done = kgs_process("fit", folder, "-o", out, *FIT, env={"PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0, done.stderr.decode()
    assert set(os.listdir(out)) >= RESULTS


def test_help_for_head():
    done = kgs_process("fit", "--help", shell="| head -1; exit ${PIPESTATUS[0]}")
    assert (done.returncode, done.stderr) == (0, b"")
