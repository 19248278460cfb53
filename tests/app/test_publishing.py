"""Whose file it is: what kgs wrote is replaced, what is the user's is kept, and a kill leaves old or new results."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command import run

from kgs._support.json_files import write_json
from kgs.app.files import publishing
from kgs.app.files.publishing import MARKER, begin, complete, discard, enter, is_own, publish, read_marker, unpublished
from kgs.app.files.publishing import replacing as replacing_files

OLD = {"a.txt": "old", "test/0.txt": "old", "test/1.txt": "old"}
NEW = {"a.txt": "new", "b.txt": "new", "test/0.txt": "new"}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def replace_all(out: Path, files: dict[str, str], kind: str = "demo") -> list[str]:
    """Replace all results of a kind; the lines that were said."""
    lines: list[str] = []
    out.mkdir(exist_ok=True)
    with replacing_files(out, kind, all_former=True, say=lines.append) as new:
        write(new, files)
    return lines


def contents(folder: Path) -> dict[str, str]:
    """The texts of all files that are not hidden."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith((".kgs", ".lock"))]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with old results."""
    folder = tmp_path / "out"
    assert replace_all(folder, OLD) == []
    return folder


def test_new_results_take_the_place_of_all_former_ones(out: Path) -> None:
    assert replace_all(out, NEW) == []
    assert contents(out) == NEW
    assert all(is_own(out, name) for name in NEW)
    assert not is_own(out, "test/1.txt")


def test_some_results_take_the_place_of_their_namesakes_alone(out: Path) -> None:
    with replacing_files(out, "demo") as new:
        write(new, {"b.txt": "new"})
    assert contents(out) == OLD | {"b.txt": "new"}
    assert is_own(out, "a.txt")
    assert is_own(out, "b.txt")


def test_what_is_changed_is_kept_and_said(out: Path) -> None:
    write(out, {"a.txt": "mine", "test/1.txt": "mine", "notes.txt": "mine"})
    (line,) = replace_all(out, NEW)
    assert line.startswith(f"{out}: moved to kept/a.txt, because this command did not write it")
    # test/1.txt is no result any more: it is the user's, and in nobody's way
    mine = {"kept/a.txt": "mine", "test/1.txt": "mine", "notes.txt": "mine"}
    assert contents(out) == NEW | mine
    write(out, {"a.txt": "mine again", "test/0.txt": "mine"})
    (line,) = replace_all(out, OLD)
    assert "moved to kept-2/a.txt, kept/test/0.txt, kept/test/1.txt, because" in line
    kept = {"a.txt": "mine", "test/0.txt": "mine", "test/1.txt": "mine"}
    assert contents(out / "kept") == kept
    assert contents(out / "kept-2") == {"a.txt": "mine again"}
    assert OLD.items() <= contents(out).items()


@pytest.mark.parametrize("kind", ["page", "fit"])
def test_results_of_another_command_are_kept(out: Path, kind: str) -> None:
    replace_all(out, {"a.txt": "new"}, kind)
    assert contents(out) == OLD | {"a.txt": "new", "kept/a.txt": "old"}


def test_a_file_folder_or_link_in_the_way_is_kept(out: Path, tmp_path: Path) -> None:
    photo = tmp_path / "photo"
    photo.write_text("old")  # as kgs wrote a.txt
    (out / "a.txt").unlink()
    (out / "a.txt").symlink_to(photo)
    shutil.rmtree(out / "test")
    write(out, {"test": "mine", "b.txt/notes.txt": "mine", "kept": "mine"})
    replace_all(out, NEW)
    assert NEW.items() <= contents(out).items()
    assert not (out / "a.txt").is_symlink()
    assert (out / "kept-2" / "a.txt").is_symlink()
    assert contents(out / "kept-2") == {"a.txt": "old", "test": "mine", "b.txt/notes.txt": "mine"}
    assert (out / "kept").read_text() == photo.read_text().replace("old", "mine")
    assert photo.read_text() == "old"


def test_a_link_to_a_folder_is_not_followed(out: Path, tmp_path: Path) -> None:
    (out / "test").rename(tmp_path / "test")
    (out / "test").symlink_to(tmp_path / "test")
    replace_all(out, NEW)
    assert contents(tmp_path / "test") == {"0.txt": "old", "1.txt": "old"}
    assert contents(out)["test/0.txt"] == "new"


def _tar(out: Path, copy: Path) -> None:
    with tarfile.open(out.with_suffix(".tar"), "w") as file:
        file.add(out, copy.name)
    with tarfile.open(out.with_suffix(".tar")) as file:
        file.extractall(copy.parent, filter="data")


def _two_seconds(out: Path, copy: Path) -> None:
    out.rename(copy)
    for path in copy.rglob("*"):
        seconds = path.stat().st_mtime // 2 * 2
        os.utime(path, (seconds, seconds))


def _plain_copy(out: Path, copy: Path) -> None:
    shutil.copytree(out, copy, copy_function=shutil.copyfile)


@pytest.mark.parametrize("moved", [_tar, _two_seconds, _plain_copy, Path.rename])
def test_a_copy_of_the_folder_goes_on(out: Path, moved: Callable[[Path, Path], Any]) -> None:
    copy = out.with_name("copy")
    moved(out, copy)
    assert replace_all(copy, NEW) == []
    assert contents(copy) == NEW


def test_after_an_error_all_is_as_it_was(out: Path) -> None:
    with suppress(KeyboardInterrupt), replacing_files(out, "demo", all_former=True) as new:
        write(new, {"a.txt": "new"})
        raise KeyboardInterrupt
    assert contents(out) == OLD
    assert sorted(os.listdir(out)) == [MARKER, ".kgs.lock", "a.txt", "test"]


def test_what_the_user_writes_meanwhile_is_kept(out: Path) -> None:
    with replacing_files(out, "demo", all_former=True) as new:
        write(new, NEW)
        write(out, {"b.txt": "mine", "test/0.txt": "mine"})
    assert contents(out) == NEW | {"kept/b.txt": "mine", "kept/test/0.txt": "mine"}


def test_a_kill_before_anything_is_written_leaves_nothing_of_the_users_to_kgs(tmp_path: Path) -> None:
    code = "import os, pathlib, sys\nfrom kgs.app.files.publishing import replacing\n"
    code += "with replacing(pathlib.Path(sys.argv[1]), 'page') as new:\n    print(new, flush=True)\n"
    code += "    os.kill(os.getpid(), 9)"
    printed = subprocess.run([sys.executable, "-c", code, tmp_path], stdout=subprocess.PIPE, check=False).stdout
    assert Path(printed.decode().strip()).is_dir()
    (tmp_path / "a.html").write_text("mine")
    with replacing_files(tmp_path, "page") as new:
        write(new, {"a.html": "new"})
    assert contents(tmp_path) == {"a.html": "new", "kept/a.html": "mine"}
    assert sorted(os.listdir(tmp_path)) == [MARKER, ".kgs.lock", "a.html", "kept"]


def test_commands_in_one_folder_lose_no_entries(tmp_path: Path) -> None:
    code = "import pathlib, sys\nfrom kgs.app.files.publishing import replacing\nout = pathlib.Path(sys.argv[1])\n"
    code += (
        "for i in range(20):\n    with replacing(out, sys.argv[2]) as new:\n        (new / f'{sys.argv[2]}{i}').touch()"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code, tmp_path, kind]) for kind in ("page", "export", "page-2")
    ]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert sorted(map(len, read_marker(tmp_path).values())) == [20, 20, 20]
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_a_folder_at_work_is_not_removed(tmp_path: Path) -> None:
    with replacing_files(tmp_path, "page") as outer:
        with replacing_files(tmp_path, "page") as inner:
            write(inner, {"b.html": "new"})
        write(outer, {"a.html": "new"})
    assert contents(tmp_path) == {"a.html": "new", "b.html": "new"}


def test_unfinished_work_gets_a_name_that_nobody_has(tmp_path: Path) -> None:
    write(tmp_path, {"unfinished-1/thesis.txt": "mine", "unfinished-2": "mine"})
    work = begin(tmp_path, "fit")
    assert work.name == "unfinished-3"
    write(work, {"config.json": "{}", "notes.txt": "mine"})
    enter(work, "fit", ["config.json", "splat.ply"])
    (work / "checkpoint").touch()
    discard(work, ["checkpoint"])
    assert contents(tmp_path) == {
        "unfinished-1/thesis.txt": "mine",
        "unfinished-2": "mine",
        "unfinished-3/notes.txt": "mine",
    }
    assert begin(tmp_path, "fit").name == "unfinished-4"


def test_what_the_user_has_in_unfinished_work_stays(tmp_path: Path) -> None:
    work = begin(tmp_path, "fit")
    write(work, {"config.json": "{}", "test/0.png": "kgs"})
    enter(work, "fit")
    mine = {"config.json": "mine", "a.tmp": "mine", "b.partial": "mine", "c.tmp/d": "mine", "checkpoint/e": "mine"}
    write(work, mine)
    lines: list[str] = []
    discard(work, ["checkpoint"], lines.append)
    assert contents(work) == mine
    (line,) = lines
    assert line.startswith(f"{work}: what is left there is not of kgs")


def test_publishing_leaves_what_the_user_put_beside_it(out: Path) -> None:
    work = begin(out, "demo")
    write(work, NEW | {"notes.txt": "mine"})
    enter(work, "demo", NEW)
    publish(work, out, all_former=True)
    assert contents(out) == NEW | {"unfinished-1/notes.txt": "mine"}


def test_two_sets_are_published_together(out: Path) -> None:
    photos = begin(out, "photos")
    write(photos, {"images/0.png": "new"})
    enter(photos, "photos")
    complete(out)
    assert not (out / "images").exists()  # they wait
    work = begin(out, "demo")
    write(work, NEW)
    enter(work, "demo")
    publish(work, out, all_former=True, along=[photos])
    assert contents(out) == NEW | {"images/0.png": "new"}
    assert sorted(os.listdir(out)) == [MARKER, ".kgs.lock", "a.txt", "b.txt", "images", "test"]


def _publish(out: Path) -> None:
    with replacing_files(out, "demo", all_former=True) as new:
        write(new, NEW)


def _finish(out: Path) -> None:
    """Photos that wait, and a fit that takes its place with them."""
    photos = begin(out, "photos")
    with replacing_files(photos, "photos") as new:
        write(new, {"images/0.png": "new"})
    work = begin(out, "demo")
    write(work, NEW)
    enter(work, "demo")
    publish(work, out, all_former=True, along=[photos])


@pytest.mark.parametrize("act", [_publish, _finish])
def test_a_kill_at_any_call_leaves_old_or_new_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Callable[[Path], None]
) -> None:
    new = NEW | ({"images/0.png": "new"} if act is _finish else {})
    calls = ("mkdir", "replace", "rename", "rmdir", "unlink")
    plain = {name: getattr(os, name) for name in calls}
    found = []
    kill_at = 0
    is_done = False
    while not is_done:
        out = tmp_path / str(kill_at)
        replace_all(out, OLD)
        (out / "mine.txt").write_text("mine")
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
        for work in (*unpublished(out, "demo"), *unpublished(out, "photos")):
            discard(work, list(NEW))
        complete(out)
        now = contents(out)
        assert now.pop("mine.txt") == "mine"
        assert now in (OLD, new), kill_at
        left_over = [path for path in out.iterdir() if path.is_dir() and path.name not in ("test", "images")]
        assert left_over == [], kill_at
        assert replace_all(out, now) == [], kill_at  # kgs knows its files
        found.append(now)
        kill_at += 1
    first_new = found.index(new)
    assert first_new > 0
    assert found[first_new:] == [new] * (len(found) - first_new)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "null",
        '{"files": 3}',
        '{"files": {"demo": 3}}',
        '{"files": {"demo": {"a.txt": 3}}}',
        '{"demo": {"a.txt": [3, 4]}}',
    ],
)
def test_a_damaged_marker_names_nothing(out: Path, content: str) -> None:
    (out / MARKER).write_text(content)
    assert not is_own(out, "a.txt")
    replace_all(out, {"a.txt": "new"})
    assert contents(out) == OLD | {"a.txt": "new", "kept/a.txt": "old"}


@pytest.mark.parametrize(
    "name", [".kgs-notes", ".kgs-venv", "unfinished-1-backup", "unfinished-x", "unfinished-2026-01-05", "unfinished-01"]
)
def test_folders_that_are_only_called_like_those_of_kgs_stay(out: Path, name: str) -> None:
    """Also copies of such, with the marker in them."""
    work = begin(out, "demo")
    write(work, {"a.txt": "new"})
    enter(work, "demo")
    work.rename(out / name)
    (out / f"{name}-empty").mkdir()
    replace_all(out, NEW)
    assert contents(out / name) == {"a.txt": "new"}
    assert (out / f"{name}-empty").is_dir()
    assert unpublished(out, "demo") == []


def test_a_marker_that_is_a_link_is_replaced(out: Path, tmp_path: Path) -> None:
    """As in a farm of links: the other folder's marker stays."""
    farm = tmp_path / "farm"
    farm.mkdir()
    (farm / MARKER).symlink_to(out / MARKER)
    before = (out / MARKER).read_bytes()
    replace_all(farm, NEW)
    assert (out / MARKER).read_bytes() == before
    assert not (farm / MARKER).is_symlink()
    assert all(is_own(farm, name) for name in NEW)


@pytest.mark.parametrize("name", [MARKER, f"{MARKER}/notes.txt"])
def test_what_is_in_the_place_of_the_marker_is_kept(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path, {name: '{"my": "notes"}'})
    for files in (OLD, NEW):
        replace_all(tmp_path, files)
    assert (tmp_path / "kept" / name).read_text() == '{"my": "notes"}'
    assert f"moved to kept/{MARKER}" in capsys.readouterr().out
    assert contents(tmp_path).items() >= NEW.items()


def test_a_folder_that_cannot_be_written_to_is_left_as_it_is(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that only read open it, and go on."""
    work = begin(out, "demo")
    write(work, NEW)
    enter(work, "demo")
    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(publishing, "complete", partial(kill, KeyboardInterrupt()))
        publish(work, out, all_former=True)
    with monkeypatch.context() as patch:
        patch.setattr(publishing, "held", partial(kill, OSError(errno.EROFS, "Read-only file system")))
        complete(out)
    assert {name: text for name, text in contents(out).items() if "/" not in name} == {"a.txt": "old"}
    complete(out)
    assert contents(out) == NEW


def kill(error: BaseException, *_: Any, **__: Any) -> None:
    raise error


def test_where_there_are_no_locks_no_folder_is_taken_for_an_abandoned_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fcntl")
    monkeypatch.setattr("fcntl.flock", partial(kill, OSError(errno.ENOLCK, "No locks available")))
    with replacing_files(tmp_path, "page") as outer:
        with replacing_files(tmp_path, "page") as inner:
            write(inner, {"b.html": "new"})
        write(outer, {"a.html": "new"})
    assert contents(tmp_path) == {"a.html": "new", "b.html": "new"}


@pytest.mark.parametrize("move", ["all", {}, {"along": ["..", "a.txt", "none"]}])
def test_a_damaged_move_removes_nothing(out: Path, move: Any) -> None:
    write(out, {"unfinished-1/thesis.txt": "mine"})
    write_json(out / "unfinished-1" / MARKER, {"move": move})
    complete(out)
    assert contents(out) == OLD | {"unfinished-1/thesis.txt": "mine"}


@pytest.mark.parametrize("name", ["../mine.txt", "{}/mine.txt", "deeper/../../mine.txt", "", ".", "deeper"])
def test_a_marker_that_names_more_than_files_below_its_folder_removes_nothing_else(tmp_path: Path, name: str) -> None:
    out = tmp_path / "out"
    (out / "deeper").mkdir(parents=True)
    mine = tmp_path / "mine.txt"
    mine.write_text("")
    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    write_json(out / MARKER, {"files": {"demo": {name.format(tmp_path): [empty]}}})
    replace_all(out, {"a.txt": "new"})
    assert mine.exists()
    assert (out / "deeper").is_dir()
    assert contents(out) == {"a.txt": "new"}


@pytest.mark.parametrize("name", ["speed", "precision", "extremes"])
def test_benchmarks_follow_the_same_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(f"kgs.bench.{name}.{name}", lambda out, **_: (out / f"{name}.md").write_text("new") and 0)
    out = tmp_path / "new"
    for _ in range(2):
        assert run("bench", name, "-o", out) == 0
    assert contents(out) == {f"{name}.md": "new"}
    (out / f"{name}.md").write_text("mine")
    assert run("bench", name, "-o", out) == 0
    assert contents(out) == {f"{name}.md": "new", f"kept/{name}.md": "mine"}
