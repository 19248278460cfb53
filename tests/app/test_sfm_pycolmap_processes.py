"""Steps of pycolmap in processes of their own: what ends such a process does not end this one."""

import errno
import json
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from limits import limited
from photo_folders import NAMES, write_planes

from kgs.app.sfm import pycolmap_processes
from kgs.app.sfm.pycolmap_processes import PycolmapProcesses, check_space

pytest.importorskip("pycolmap")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="limits and signals of POSIX")


@pytest.fixture
def own_matches(tmp_path):
    """The arguments of the longer step."""
    images = write_planes(tmp_path / "photos")
    return {"images": str(images), "lenses": [[list(NAMES), None]], "masks": None, "seed": 0}


def test_a_full_disk_is_an_error_and_not_the_end(tmp_path, own_matches):
    with PycolmapProcesses() as steps, limited(400_000), pytest.raises(OSError, match=str(tmp_path)) as caught:
        steps.run("write_colmap_matches", tmp_path / "second.db", **own_matches)
    assert caught.value.errno == errno.EFBIG
    assert not (tmp_path / "probe").exists()
    check_space(tmp_path)
    assert not (tmp_path / "probe").exists()


def test_another_failure_says_what_pycolmap_said(tmp_path, own_matches):
    with PycolmapProcesses() as steps, pytest.raises(RuntimeError, match=r"pycolmap: .*nowhere"):
        steps.run("write_colmap_matches", tmp_path / "second.db", **own_matches | {"images": str(tmp_path / "nowhere")})


def test_what_pycolmap_says_of_a_disk_that_has_room_again(tmp_path):
    said = "terminate called\n  what():  SQLite error: database or disk is full\n"
    error = pycolmap_processes._failure(-6, said, tmp_path / "a.db")
    assert (type(error), error.errno, error.filename) == (OSError, errno.ENOSPC, str(tmp_path))
    assert isinstance(pycolmap_processes._failure(-9, "", tmp_path / "a.db"), MemoryError)
    assert (
        str(pycolmap_processes._failure(-6, "  what():  out of order\nat 0x7f\n", tmp_path / "a.db"))
        == "pycolmap: out of order"
    )


def test_steps_end_with_the_block(tmp_path, own_matches):
    """As at Ctrl-C: a step in another thread is not waited for."""
    with ThreadPoolExecutor(1) as beside:
        with PycolmapProcesses() as steps:
            step = beside.submit(steps.run, "write_colmap_matches", tmp_path / "second.db", **own_matches)
            while not steps._at_work:
                time.sleep(0.01)
        with pytest.raises(MemoryError):
            step.result(10)
        with pytest.raises(MemoryError):
            steps.run("verify", tmp_path / "second.db", seed=0)  # none begins after that


def test_a_step_ends_with_the_process_that_began_it(monkeypatch):
    """The pipe to it is closed then, however that process ended."""
    left = threading.Event()
    monkeypatch.setattr(pycolmap_processes.os, "_exit", lambda code: left.set() if code == 1 else None)
    read, write = pycolmap_processes.os.pipe()
    with open(read) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        watching = threading.Thread(target=pycolmap_processes._end_with_the_parent)
        watching.start()
        assert not left.wait(0.05)
        pycolmap_processes.os.close(write)
        assert left.wait(10)
        watching.join()


def test_the_process_needs_nothing_of_kgs(tmp_path):
    """It finds pycolmap where this process does, whatever its working folder and its environment."""
    database = str(tmp_path / "none" / "a.db")
    request = {"path": sys.path, "step": "verify", "database": database, "arguments": {"seed": 0}}
    done = subprocess.run(
        [sys.executable, "-P", pycolmap_processes.__file__],
        input=json.dumps(request) + "\n",
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert "ModuleNotFoundError" not in done.stderr
