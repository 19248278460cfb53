"""Folders of results: which may be one, how new results replace former ones, and what a kill leaves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command import one_line, run

from kgs._support.errors import DataError
from kgs.app.files.results import MARKER, UNFINISHED, Results, complete, read_marker

OLD = {"a.txt": "old", "test/0.txt": "old", "test/1.txt": "old"}
NEW = {"a.txt": "new", "b.txt": "new", "test/0.txt": "new"}
FIT = {"splat.ply": "new", "test/0.png": "new", "checkpoint.safetensors": "new"}
PHOTOS = {"photos.json": "new", "images/0.png": "new"}
MINE = {"notes.txt": "mine", "test/notes.txt": "mine"}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def replace_all(out: Path, files: dict[str, str], kind: str = "fit", **options: Any) -> None:
    with Results.open(out, kind, **options) as results, results.stage() as new:
        write(new, files)


def contents(folder: Path) -> dict[str, str]:
    """The texts of all files that are not hidden."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".kgs")]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with old results, and files of the user."""
    folder = tmp_path / "out"
    replace_all(folder, OLD)
    write(folder, MINE)
    return folder


# -- which folders ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "files",
    [
        {},
        {".kgs.lock": ""},  # another process is just beginning there
        {MARKER: '{"files": {}}'},
        {MARKER: '{"files": {"fit": {"a.txt": "a SHA-256"}}}', "a.txt": "of a former version"},
    ],
)
def test_a_new_or_empty_folder_and_one_of_kgs_are_taken(tmp_path: Path, files: dict[str, str]) -> None:
    write(tmp_path, files)
    replace_all(tmp_path, NEW)
    assert contents(tmp_path) == NEW
    assert read_marker(tmp_path) == {"fit": sorted(NEW)}


@pytest.mark.parametrize("name", ["photo.jpg", "poses_bounds.npy", ".git/x", ".kgs-notes", UNFINISHED, "splat.ply"])
def test_any_other_folder_is_refused_and_stays(tmp_path: Path, name: str) -> None:
    write(tmp_path, {name: "mine"})
    with pytest.raises(DataError, match=rf"got one with {name.partition('/')[0]}") as error:
        replace_all(tmp_path, NEW)
    assert error.value.path == tmp_path
    assert [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()] == [name]


@pytest.mark.parametrize("name", ["file", "file/below/that", "dangling"])
def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DataError) as error:
        replace_all(tmp_path / name, NEW)
    assert error.value.path == tmp_path / name


def test_a_folder_without_permission_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)  # tests may run as root, who has every permission
    with pytest.raises(DataError, match="no permission for"):
        replace_all(tmp_path / "new", NEW)


def test_results_of_another_kind_are_refused_unless_they_may_be_there(out: Path) -> None:
    with pytest.raises(DataError, match="expected a folder for scale, got one of kgs with fit"):
        replace_all(out, NEW, "scale")
    replace_all(out, PHOTOS, "photos", beside=["fit"])
    assert contents(out) == OLD | MINE | PHOTOS


@pytest.mark.parametrize(
    "content",
    ["", "[]", '{"files": 3}', '{"files": {"fit": 3}}', '{"files": {"fit": [3]}}', '{"my": "notes"}']
    + [json.dumps({"files": {"fit": [name]}}) for name in ("../a", "/a", "b/../../a", "", ".")],
)
def test_a_damaged_marker_is_refused_and_stays(out: Path, content: str) -> None:
    (out / MARKER).write_text(content)
    with pytest.raises(DataError) as error:
        replace_all(out, NEW)
    assert error.value.path == out / MARKER
    assert contents(out) == OLD | MINE
    assert (out / MARKER).read_text() == content


# -- new results for former ones -------------------------------------------------------------------------------------


def test_new_results_take_the_place_of_all_former_ones(out: Path) -> None:
    write(out, {"b.txt": "mine"})  # a name that kgs writes is kgs's
    replace_all(out, NEW)
    assert contents(out) == NEW | MINE
    (out / "test/notes.txt").unlink()
    replace_all(out, {"a.txt": "new"})
    assert not (out / "test").exists()


def test_some_results_take_the_place_of_their_namesakes_alone(out: Path) -> None:
    with Results.open(out, "fit") as results, results.stage(keep=True) as new:
        write(new, {"b.txt": "new"})
    assert contents(out) == OLD | MINE | {"b.txt": "new"}
    assert read_marker(out) == {"fit": sorted([*OLD, "b.txt"])}


def test_after_an_error_all_is_as_it_was(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill(folder: Path, _: Any) -> None:
        raise OSError(28, "No space left on device", str(folder / "a.txt"))

    monkeypatch.setattr(f"{__name__}.write", fill)
    with pytest.raises(OSError, match="No space left") as error:
        replace_all(out, NEW)
    assert error.value.filename == str(out / "a.txt")  # not of the folder that is gone
    assert contents(out) == OLD | MINE
    assert sorted(os.listdir(out)) == [MARKER, ".kgs.lock", "a.txt", "notes.txt", "test"]


@pytest.mark.parametrize("is_there", [True, False])
def test_without_results_a_folder_is_left_as_it_was(tmp_path: Path, is_there: bool) -> None:
    folder = tmp_path / "a" / "out"
    if is_there:
        folder.mkdir(parents=True)
    with Results.open(folder, "fit"):
        assert folder.exists() == is_there
    with suppress(KeyboardInterrupt), Results.open(folder, "fit") as results, results.stage():
        raise KeyboardInterrupt
    assert not is_there or os.listdir(folder) == []
    assert folder.exists() == is_there


@pytest.mark.parametrize("kinds", [("fit",), ("fit", "photos")])
def test_the_folder_of_a_fit_is_published_with_its_own_photos_alone(out: Path, kinds: tuple[str, ...]) -> None:
    with Results.open(out, "fit", beside=["photos"]) as results:
        write(results.work, FIT | PHOTOS | MINE | {"a.partial": "", ".kgs-0.tmp": ""})
        results.publish(*kinds)
    assert contents(out) == FIT | (PHOTOS if "photos" in kinds else {}) | MINE | {
        f"{UNFINISHED}/{name}": "mine" for name in MINE
    }
    assert {*read_marker(out)} == {*kinds}


def test_what_is_discarded_is_kgs_s(out: Path) -> None:
    with Results.open(out, "fit") as results:
        write(results.work, FIT | PHOTOS | MINE)
        results.discard("fit")
        assert contents(results.work) == PHOTOS | MINE
        results.discard("photos")
        assert contents(results.work) == MINE
        for name in MINE:
            (results.work / name).unlink()
        results.discard("fit")
        assert not results.work.exists()


def test_an_unfinished_fit_is_refused_unless_it_is_resumed(out: Path) -> None:
    write(out / UNFINISHED, FIT)
    with pytest.raises(DataError, match="--resume") as error, Results.open(out, "fit", resume=False):
        pass
    assert error.value.path == out / UNFINISHED
    with Results.open(out, "fit", resume=True):
        pass
    assert contents(out / UNFINISHED) == FIT


# -- locks and kills -------------------------------------------------------------------------------------------------


def test_one_command_at_a_time_and_a_kill_leaves_no_lock(out: Path) -> None:
    code = "import sys, time, pathlib\nfrom kgs.app.files.results import Results\n"
    code += "with Results.open(pathlib.Path(sys.argv[1]), 'fit'):\n    print('held', flush=True)\n    time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code, out], stdout=subprocess.PIPE) as process:
        assert process.stdout.readline()
        with pytest.raises(DataError, match="at work"):
            replace_all(out, NEW)
        process.kill()
    replace_all(out, NEW)


def _stage(out: Path) -> None:
    replace_all(out, NEW)


def _publish(out: Path) -> None:
    with Results.open(out, "fit", beside=["photos"]) as results:
        write(results.work, FIT | PHOTOS)
        results.publish("fit", "photos")


@pytest.mark.parametrize(("act", "new"), [(_stage, NEW), (_publish, FIT | PHOTOS)])
def test_a_kill_at_any_call_leaves_old_or_new_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Callable[[Path], None], new: dict[str, str]
) -> None:
    calls = ("mkdir", "replace", "rename", "rmdir", "unlink")
    plain = {name: getattr(os, name) for name in calls}
    found = []
    kill_at = 0
    is_done = False
    while not is_done:
        out = tmp_path / str(kill_at)
        replace_all(out, OLD)
        write(out, MINE)
        left = iter(range(kill_at))

        def until_killed(name: str, *arguments: Any, left: Any = left, **options: Any) -> Any:
            if next(left, None) is None:  # and from then on nothing happens any more, as in a killed process
                raise KeyboardInterrupt
            return plain[name](*arguments, **options)

        with monkeypatch.context() as patch:
            for name in calls:
                patch.setattr(os, name, partial(until_killed, name))
            try:
                act(out)
                is_done = True
            except KeyboardInterrupt:
                pass
        complete(out)
        with Results.open(out, "fit", beside=["photos"]) as results:
            results.discard("fit", "photos")
        now = contents(out)
        assert now in (OLD | MINE, new | MINE), kill_at
        assert {path.name for path in out.iterdir() if path.is_dir()} <= {"test", "images"}, kill_at
        assert {name for names in read_marker(out).values() for name in names} == {*now}.difference(MINE), kill_at
        found.append(now)
        kill_at += 1
    first_new = found.index(new | MINE)
    assert first_new > 0
    assert found[first_new:] == [new | MINE] * (len(found) - first_new)


def test_a_command_that_only_reads_ends_a_move_where_it_can_write(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(Results, "_move", lambda self: (self.out / ".kgs-whole").exists() and kill())
        _stage(out)
    before = contents(out)
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda *_: False)
        complete(out)
    assert contents(out) == before
    complete(out)
    assert contents(out) == NEW | MINE


def kill() -> None:
    raise KeyboardInterrupt


# -- commands --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["speed", "precision", "extremes"])
def test_benchmarks_share_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(f"kgs.bench.{name}.{name}", lambda out, **_: (out / f"{name}.md").write_text("new") and 0)
    replace_all(tmp_path, {"other.md": "old"}, "bench")
    for _ in range(2):
        assert run("bench", name, "-o", tmp_path) == 0
    assert contents(tmp_path) == {f"{name}.md": "new", "other.md": "old"}


BY = "--by 0,0,0 1,0,0 2"
FILES = [
    ("export {fit} -o {out}/a.ply", "a.ply"),
    ("clean {fit}/splat.ply -o {out}/a.ply", "a.ply"),
    (f"scale {{fit}}/splat.ply {BY} -o {{out}}/a.ply", "a.ply"),
    ("page {fit} -o {out}/a.html", "a.html"),
]
FOLDERS = [
    ("fit {scene} -o {out}", "splat.ply"),
    ("demo -o {out} --size 32", "splat.ply"),
    (f"scale {{fit}} {BY} -o {{out}}", "splat.ply"),
    ("render {fit} -o {out}", "train_r_0.png"),
    *((f"bench {name} -o {{out}}", f"{name}.md") for name in ("speed", "precision", "extremes")),
]


@pytest.mark.parametrize(("words", "name"), FILES + FOLDERS)
def test_no_command_replaces_a_file_of_the_user(
    folder: Path, fitted: Path, tmp_path: Path, capsys: Any, words: str, name: str
) -> None:
    write(tmp_path, {name: "mine"})
    assert run(*words.format(scene=folder, fit=fitted, out=tmp_path).split()) == 3
    assert name in one_line(capsys)
    assert contents(tmp_path) == {name: "mine"}
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize(("words", "name"), [FILES[0], FILES[-1]])  # a splat, and a page
def test_a_file_that_kgs_wrote_is_replaced_unless_it_is_one_of_a_fit(
    folder: Path, fitted: Path, tmp_path: Path, capsys: Any, words: str, name: str
) -> None:
    given = words.format(scene=folder, fit=fitted, out=tmp_path).split()
    assert run(*given) == 0
    first = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(first[: len(first) // 2])
    assert run(*given) == 0
    assert (tmp_path / name).read_bytes() == first
    assert os.listdir(tmp_path) == [name]
    (tmp_path / MARKER).write_text(json.dumps({"files": {"fit": [name]}}))
    capsys.readouterr()
    assert run(*given) == 3
    assert name in one_line(capsys)
    assert (tmp_path / name).read_bytes() == first


def test_a_folder_of_a_fit_stands_for_its_splat_and_its_scene(folder: Path, fitted: Path, tmp_path: Path) -> None:
    """But for its title, which names the splat, the page is the same."""
    splat = fitted / "splat.ply"
    for given, name in (([fitted], "a"), ([splat, "--cameras", folder], "b")):
        assert run("render", *given, "-o", tmp_path / name) == 0
        assert run("page", *given, "-o", tmp_path / f"{name}.html", "--no-photos") == 0
    pictures = [{path.name: path.read_bytes() for path in (tmp_path / name).glob("*.png")} for name in "ab"]
    assert len(pictures[0]) == 6
    assert pictures[0] == pictures[1]
    pages = [(tmp_path / f"{name}.html").read_text(encoding="utf-8") for name in "ab"]
    assert pages[0].replace(f"{fitted.name}, ", "splat, ") == pages[1]
