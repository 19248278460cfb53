"""The command `kgs` and what it writes to: pipes, closed streams, names that a terminal cannot show."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from command import run

MAIN = "import kgs.app.cli; kgs.app.cli.main()"


def kgs_process(*arguments, shell):
    command = ["bash", "-c", f'"$@" {shell}', "bash", sys.executable, "-c", MAIN, *map(str, arguments)]
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": ""}
    return subprocess.run(command, capture_output=True, timeout=200, env=env)


FIT = ("--init", "random", "--init-points", 50, "--steps", 2)
RESULTS = {"index.html", "splat.ply", "metrics.json", "config.json", "curve.png", "test"}


@pytest.mark.slow
def test_results_are_written_where_all_streams_are_closed(folder, tmp_path):
    done = kgs_process("fit", folder, "-o", tmp_path / "out", *FIT, shell="<&- >&- 2>&-")
    assert done.returncode == 0
    assert set(os.listdir(tmp_path / "out")) >= RESULTS


def fit_here(folder, out, monkeypatch, *streams):
    """A fit in this process that writes to these streams: its exit code."""
    for name, stream in zip(("stdout", "stderr"), streams, strict=True):
        monkeypatch.setattr(sys, name, stream)
    code = run("fit", folder, "-o", out, *FIT)
    monkeypatch.undo()
    return code


def test_results_are_written_where_nothing_can_be_said(folder, tmp_path, monkeypatch):
    """As with `| head -1` and on a full disk, without the time of another process."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as gone, open("/dev/full", "w") as full:  # closed as at exit: nothing is left to be written
        assert fit_here(folder, tmp_path / "out", monkeypatch, gone, full) == 0
    assert set(os.listdir(tmp_path / "out")) >= RESULTS


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
import importlib.util, sys

class NoTorch:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "numpy", "cv2", "kornia"):
            return importlib.util.spec_from_loader(name, NoTorch)

    def create_module(spec):
        sys.exit(f"{spec.name} is imported")

    def exec_module(module):
        pass

sys.meta_path.insert(0, NoTorch)
import kgs.app.cli
kgs.app.cli.main()
"""


MISTAKES = [  # words, what is said of them, and a package that is not installed
    ("fti", "did you mean fit?", ""),
    ("fit photos -o out --steps many", "--steps", ""),
    ("fit photos -o out --steps 0", "--steps: expected", ""),
    ("fit photos -o out --size 99 --downscale 2", "--size: expected either", ""),
    ("fit photos -o out --views 0", "--views: expected", ""),
    ("fit photos -o out --views 5", "--views: expected at most 4", ""),
    ("fit twelve -o out --hold-out 4 --views 11", "--views: expected at most 10 of 12 photos of which 2", ""),
    ("fit film.mp4 -o out --frames 5 --views 6", "--views: expected at most 5 of 5 frames, got 6", ""),
    ("fit film.mp4 -o out --hold-out 2 --views 30", "--views: expected at most 19 of 36 frames", ""),
    ("fit film.mp4 -o out --frames 2", "--frames: expected", ""),
    ("fit photos -o out --frames 12", "--frames: expected", ""),
    ("fit photos -o out --init scene", "--init: expected another one for photos", ""),
    ("fit posed -o out --init scene", "--init: expected another one for the layout COLMAP", ""),
    ("fit photos -o out --downscale 0.5", "--downscale: expected", ""),
    ("fit photos -o out --hold-out 1", "--hold-out: expected", ""),
    ("fit photos -o out --lpips-weights empty", "empty/vgg16_features.npz: expected", ""),
    ("fit photos -o photos", "photos: expected a new or empty folder", ""),
    ("fit missing -o out", "missing: expected a file or folder, got none", ""),
    ("fit empty -o out", "empty: expected photos", ""),
    (
        "fit photos/0.png -o out",
        "photos/0.png: expected a folder, got a file: for photos, name their folder: photos",
        "",
    ),
    (
        "fit photos/0.png photos/1.png photos/2.png photos/3.png -o out",
        "expected one path, got 4 (0.png, 1.png, 2.png and 1 more). For photos, name their folder",
        "",
    ),
    ("fit two -o out", "two: expected at least 3 photos, got 2", ""),
    ("fit poses -o out", "poses: expected photos in images/, or where", ""),
    ("fit heic -o out", "heic: expected photos that can be read, got 1 of 4", "pi_heif"),
    ("fit photos -o out --backend numba", 'numba is missing: run pip install ".[fast]"', "numba"),
    ("fit photos -o out", 'pycolmap is missing: run pip install ".[sfm]"', "pycolmap"),
    ("fit photos -o out", 'jinja2 is missing: run pip install ".[app]"', "jinja2"),
    ("fit photos -o out", 'tyro is missing: run pip install ".[app]"', "tyro"),
    ("demo -o out --size 31", "--size: expected", ""),
    ("render taken/splat.ply --cameras empty -o out", "empty: expected a scene", ""),
    ("eval empty", "empty/config.json: expected", ""),
    ("page taken/splat.ply --cameras poses -o out", "--out: expected a file that ends in .html", ""),
    ("study -o out", 'pandas is missing: run pip install ".[study]"', "pandas"),
    ("study -o out", 'matplotlib is missing: run pip install ".[app]"', "matplotlib"),
    ("study -o out --lpips-weights missing", "missing: expected a file or folder, got none", ""),
]
RUN_ALL = """
for words, said, package in json.load(sys.stdin):
    sys.modules |= {package: None} if package else {}
    folders.has_heic.cache_clear()
    try:
        kgs.app.cli.main(words.split())
    except SystemExit as stop:
        print("exit", stop.code, file=sys.stderr)
    sys.modules.pop(package, None)
"""


def test_what_folders_and_options_show_is_told_before_torch_is_loaded(tmp_path):
    """In one process, whose start would take most of the time."""
    counts = {"empty": 0, "two": 2, "photos": 4, "twelve": 12, "heic": 3, "poses/sparse/0": 0, "taken": 0}
    counts |= {"posed/sparse/0": 0, "posed/images": 2}
    for name, count in counts.items():
        (tmp_path / name).mkdir(parents=True)
        for i in range(count):
            (tmp_path / name / f"{i}.png").touch()
    for name in (
        "heic/a.heic",
        "poses/sparse/0/images.bin",
        "posed/sparse/0/images.bin",
        "taken/splat.ply",
        "film.mp4",
    ):
        (tmp_path / name).touch()
    before = sorted(tmp_path.rglob("*"))
    imports = "import json\nimport kgs.app.cli\nfrom kgs.datasets import folders\n"
    code = WITHOUT_TORCH.replace("import kgs.app.cli\nkgs.app.cli.main()", imports + RUN_ALL)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, input=json.dumps(MISTAKES), capture_output=True, text=True, timeout=60)
    *texts, _ = re.split(r"exit (\d+)\n", done.stderr)
    assert len(texts) == 2 * len(MISTAKES), done.stderr
    for (words, said, _), text, code in zip(MISTAKES, texts[::2], texts[1::2], strict=True):
        assert said in text, words
        is_file = re.match(r"kgs: (missing|empty|two|poses|photos|heic)\b", text)
        assert code == ("1" if "is missing: run" in text else "3" if is_file else "2"), words
        assert text.startswith(("kgs: ", "╭")), words  # a line of ours, or a box of tyro's
        lines = 3 if text.startswith("kgs: heic") else 1  # with advice
        assert text.count("\n") == lines or text[0] == "╭", words
    assert sorted(tmp_path.rglob("*")) == before


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
import kgs.app.cli
kgs.app.cli.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_while_torch_is_imported_is_quiet(tmp_path):
    command = [sys.executable, "-c", SLOW_TORCH, "demo", "-o", "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, **pipes) as process:
        assert process.stdout.readline() == b"torch\n"
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr.read() == b""


def test_ctrl_c_raises_as_usual_after_a_command():
    before = signal.getsignal(signal.SIGINT)
    assert run("nonsense") == 2
    assert signal.getsignal(signal.SIGINT) is before
