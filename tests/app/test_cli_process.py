"""The command `kgs` and what it writes to: pipes, closed streams, names that a terminal cannot show."""

import ctypes
import io
import json
import os
import signal
import subprocess
import sys
import time
from importlib.machinery import PathFinder

import pytest

from kgs.app.cli import checks, main

MAIN = "import kgs.app.cli; kgs.app.cli.main()"


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


MISTAKES = {  # words, and what is said of them; "blocked": a package that cannot be found
    "an empty folder": ("fit empty -o out", "empty: expected photos"),
    "two photos": ("fit two -o out", "two: expected at least 3 photos, found 2 (0.png, 1.png)"),
    "poses without photos": ("fit poses -o out", "poses: has camera poses but no photos"),
    "a folder of somebody else": ("fit photos -o taken", "taken/splat.ply: was not written by kgs"),
    "among the photos": ("fit photos -o photos", "photos: holds files of a scene"),
    "a range": ("fit photos -o out --steps 0", "--steps: expected a whole number in [1, 10000000], got '0'"),
    "another range": ("fit photos -o out --drop 2", "--drop: expected a finite number in [0, 1), got '2.0'"),
    "two sizes": (
        "fit photos -o out --size 99 --downscale 2",
        "--size: expected either a size or a downscale factor, got both",
    ),
    "no views": ("fit photos -o out --views 0", "--views: expected a whole number of at least 1, got 0"),
    "too many views": ("fit photos -o out --views 5", "--views: expected at most 4 of 4 photos, got 5"),
    "no reduction": ("fit photos -o out --downscale 0.5", "--downscale: expected None or a number of at least 1"),
    "all held out": ("fit photos -o out --hold-out 1", "--hold-out: expected None, 0 or a whole number of at least 2"),
    "no device": ("fit photos -o out --device gpu", "--device: expected cpu or a GPU of this machine, got 'gpu'"),
    "no weights": ("fit photos -o out --lpips-weights empty", "empty/vgg16_features.npz: expected an npz file"),
    "no numba": ("fit photos -o out --backend numba", 'numba is missing: run pip install -e ".[fast]"'),
    "no pycolmap": ("fit photos -o out", 'pycolmap is missing: run pip install -e ".[sfm]"'),
    "no matplotlib": ("fit photos -o out", 'matplotlib is missing: run pip install -e ".[app]"'),
    "no pi_heif": ("fit heic -o out", "heic: 1 of 4 photos cannot be read (a.heic). kgs reads PNG"),
    "a demo": ("demo -o out --size 11 40", "--size: expected at least 12 pixels a side, got 11 40"),
    "a demo elsewhere": ("demo -o taken", "taken/splat.ply: was not written by kgs"),
    "no cameras": ("render taken/splat.ply --cameras empty -o out", "empty: is not a scene"),
    "no fit": ("eval empty", "empty/config.json: cannot be read"),
    "no page": ("page taken/splat.ply --cameras poses -o out", "--out: expected a file that ends in .html"),
}
RUN_ALL = """
for name, words in json.load(sys.stdin).items():
    package = name.removeprefix("no ") if name.startswith("no ") else ""
    sys.modules |= {package: None} if package in ("numba", "pycolmap", "matplotlib", "pi_heif") else {}
    folders.has_heic.cache_clear()
    try:
        kgs.app.cli.main(words.split())
    except SystemExit as stop:
        print(name, stop.code, file=sys.stderr)
    sys.modules.pop(package, None)
"""


def test_what_folders_and_options_show_is_told_before_torch_is_loaded(tmp_path):
    """In one process, whose start would take most of the time."""
    for name, count in (("empty", 0), ("two", 2), ("photos", 4), ("heic", 3), ("poses/sparse/0", 0), ("taken", 0)):
        (tmp_path / name).mkdir(parents=True)
        for i in range(count):
            (tmp_path / name / f"{i}.png").touch()
    for name in ("heic/a.heic", "poses/sparse/0/images.bin", "taken/splat.ply"):
        (tmp_path / name).touch()
    before = sorted(tmp_path.rglob("*"))
    imports = "import json\nimport kgs.app.cli\nfrom kgs.datasets import folders\n"
    code = WITHOUT_TORCH.replace("import kgs.app.cli\nkgs.app.cli.main()", imports + RUN_ALL)
    words = json.dumps({name: words for name, (words, _) in MISTAKES.items()})
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, input=words, capture_output=True, text=True, timeout=60
    )
    lines = done.stderr.splitlines()
    assert lines[1::2] == [f"{name} 2" for name in MISTAKES], done.stderr
    for (name, (_, said)), line in zip(MISTAKES.items(), lines[::2], strict=True):
        assert line.startswith(f"kgs: {said}"), name
    assert sorted(tmp_path.rglob("*")) == before


def test_cuda_that_cannot_be_there_is_told_before_torch_is_loaded(tmp_path, monkeypatch):
    version = tmp_path / "torch" / "version.py"
    version.parent.mkdir()
    (tmp_path / "torch" / "__init__.py").touch()
    monkeypatch.setattr(checks, "find_spec", lambda name: PathFinder.find_spec(name, [str(tmp_path)]))
    version.write_text("cuda: Optional[str] = None\nhip: Optional[str] = None\n")
    assert checks._why_no_device("cuda") == "torch is installed without CUDA"
    for built in ("cuda: Optional[str] = None\nhip: Optional[str] = '6.2'\n", "cuda = None\nhip = '6.2'\n"):
        version.write_text(built)
        assert checks._why_no_device("cuda") == ""  # for AMD, as torch calls it
    version.write_text("cuda: Optional[str] = '12.8'\nhip: Optional[str] = None\n")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: None)
    assert checks._why_no_device("cuda") == ""

    def without_a_driver(name):
        raise OSError(name)

    monkeypatch.setattr(ctypes, "CDLL", without_a_driver)
    monkeypatch.setattr(sys, "platform", "linux")
    assert checks._why_no_device("cuda") == "there is no driver of NVIDIA"


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
