"""Whose file it is: what kgs wrote is replaced, what is the user's is not, and a kill leaves old or new results."""

from __future__ import annotations

import errno
import os
import re
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
from command import one_line, run

from kgs._support.errors import DataError
from kgs._support.json_files import write_json
from kgs.app.files import publishing
from kgs.app.files.publishing import (
    MARKER,
    UNFINISHED,
    check_free,
    complete,
    discard,
    is_own,
    publish,
    read_marker,
    replacing,
)

OLD = {"a.txt": "old", "test/0.txt": "old", "test/1.txt": "old"}
NEW = {"a.txt": "new", "b.txt": "new", "test/0.txt": "new"}


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def replace_all(out: Path, files: dict[str, str], kind: str = "demo") -> None:
    """Replace all results of a kind."""
    check_free(out, kind, files)
    with replacing(out, kind, all_former=True) as new:
        write(new, files)


def unfinished(out: Path, files: dict[str, str], kind: str = "demo") -> Path:
    """The unfinished folder in a folder, with results."""
    work = out / UNFINISHED
    with replacing(work, kind) as new:
        write(new, files)
    return work


def refused(*names: str) -> Any:
    """Expects an error that names these files and says what to do."""
    said = f", or that was changed since, got {', '.join(names)}: move it away"
    return pytest.raises(DataError, match=re.escape(said))


def contents(folder: Path) -> dict[str, str]:
    """The texts of all files that are not hidden."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith((".kgs", ".lock"))]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder with old results."""
    folder = tmp_path / "out"
    replace_all(folder, OLD)
    return folder


def test_new_results_take_the_place_of_all_former_ones(out: Path) -> None:
    replace_all(out, NEW)
    assert contents(out) == NEW
    assert all(is_own(out, name) for name in NEW)
    assert not is_own(out, "test/1.txt")


def test_some_results_take_the_place_of_their_namesakes_alone(out: Path) -> None:
    with replacing(out, "demo") as new:
        write(new, {"b.txt": "new"})
    assert contents(out) == OLD | {"b.txt": "new"}
    assert is_own(out, "a.txt")
    assert is_own(out, "b.txt")


def test_what_is_changed_is_refused_before_any_work(out: Path) -> None:
    write(out, {"a.txt": "mine", "test/0.txt": "mine", "test/1.txt": "mine", "notes.txt": "mine"})
    before = contents(out)
    with refused("a.txt", "test/0.txt"):  # test/1.txt is no result any more
        check_free(out, "demo", NEW)
    assert contents(out) == before
    for name in ("a.txt", "test/0.txt"):
        (out / name).unlink()
    replace_all(out, NEW)
    assert contents(out) == NEW | {"test/1.txt": "mine", "notes.txt": "mine"}


def test_results_of_another_command_stay(out: Path) -> None:
    replace_all(out, {"c.txt": "new"}, "page")
    assert contents(out) == OLD | {"c.txt": "new"}


def test_a_file_folder_or_link_of_that_name_is_refused(out: Path, tmp_path: Path) -> None:
    photo = tmp_path / "photo"
    photo.write_text("old")  # as kgs wrote a.txt
    (out / "a.txt").unlink()
    (out / "a.txt").symlink_to(photo)
    shutil.rmtree(out / "test")
    write(out, {"test": "mine", "b.txt/notes.txt": "mine"})
    with refused("a.txt", "b.txt", "test"):
        check_free(out, "demo", NEW)


def test_a_link_to_a_folder_is_not_followed(out: Path, tmp_path: Path) -> None:
    (out / "test").rename(tmp_path / "test")
    (out / "test").symlink_to(tmp_path / "test")
    with refused("test"):
        check_free(out, "demo", NEW)
    replace_all(out, {"a.txt": "new"})
    assert contents(tmp_path / "test") == {"0.txt": "old", "1.txt": "old"}


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
    replace_all(copy, NEW)
    assert contents(copy) == NEW


def test_after_an_error_all_is_as_it_was(out: Path) -> None:
    with suppress(KeyboardInterrupt), replacing(out, "demo", all_former=True) as new:
        write(new, {"a.txt": "new"})
        raise KeyboardInterrupt
    assert contents(out) == OLD
    assert sorted(os.listdir(out)) == [MARKER, ".kgs.lock", "a.txt", "test"]


def test_what_the_user_writes_meanwhile_is_refused_and_the_new_results_wait(out: Path) -> None:
    mine = {"b.txt": "mine", "test/0.txt": "mine"}
    with refused("b.txt", "test/0.txt"), replacing(out, "demo", all_former=True) as new:
        write(new, NEW)
        write(out, mine)
    for _ in range(2):
        with pytest.raises(DataError, match=r"the new results wait in \.kgs-\w+, and the next command here then"):
            check_free(out, "demo", NEW)
        now = contents(out)
        assert {name: now[name] for name in OLD | mine} == OLD | mine
        with refused("b.txt", "test/0.txt"):
            complete(out)
    for name in mine:
        (out / name).rename(out / f"my {Path(name).name}")
    complete(out)
    assert contents(out) == NEW | {"my b.txt": "mine", "my 0.txt": "mine"}


def test_a_kill_before_anything_is_written_leaves_nothing_of_the_users_to_kgs(tmp_path: Path) -> None:
    code = "import os, pathlib, sys\nfrom kgs.app.files.publishing import replacing\n"
    code += "with replacing(pathlib.Path(sys.argv[1]), 'page') as new:\n    print(new, flush=True)\n"
    code += "    os.kill(os.getpid(), 9)"
    printed = subprocess.run([sys.executable, "-c", code, tmp_path], stdout=subprocess.PIPE, check=False).stdout
    assert Path(printed.decode().strip()).is_dir()
    (tmp_path / "a.html").write_text("mine")
    with refused("a.html"):
        check_free(tmp_path, "page", ["a.html"])
    assert contents(tmp_path) == {"a.html": "mine"}
    assert sorted(os.listdir(tmp_path)) == [".kgs.lock", "a.html"]


def test_commands_in_one_folder_lose_no_entries(tmp_path: Path) -> None:
    code = "import pathlib, sys\nfrom kgs.app.files.publishing import replacing\nout = pathlib.Path(sys.argv[1])\n"
    code += (
        "for i in range(20):\n    with replacing(out, sys.argv[2]) as new:\n        (new / f'{sys.argv[3]}{i}').touch()"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code, tmp_path, kind, name])
        for kind, name in (("page", "a"), ("export", "b"), ("page", "c"))
    ]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert sorted(map(len, read_marker(tmp_path).values())) == [20, 40]
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_what_the_user_has_in_an_unfinished_folder_stays(tmp_path: Path) -> None:
    mine = {"config.json": "mine", "a.tmp": "mine", "b.partial": "mine", "c.tmp/d": "mine", "test/notes.txt": "mine"}
    work = unfinished(tmp_path, {"config.json": "{}", "test/0.png": "kgs"})
    write(work, mine | {"checkpoint": "kgs"})
    with refused("config.json"):
        check_free(work, "demo", ["config.json", "test/0.png"])
    discard(work, "demo", ["checkpoint"])
    assert contents(work) == mine
    assert sorted(os.listdir(work)) == ["a.tmp", "b.partial", "c.tmp", "config.json", "test"]
    (work / "config.json").unlink()
    discard(unfinished(tmp_path, {"config.json": "{}"}), "demo")
    del mine["config.json"]
    assert contents(work) == mine


def test_an_unfinished_folder_goes_when_it_is_discarded(tmp_path: Path) -> None:
    unfinished(tmp_path, {"images/0.png": "kgs"}, "photos")
    work = unfinished(tmp_path, {"config.json": "{}"}, "fit")
    (work / f".kgs-{'0' * 32}.tmp").touch()  # of a process that was killed
    (work / f".kgs-{'0' * 32}").mkdir()
    discard(work, "fit")
    assert contents(work) == {"images/0.png": "kgs"}
    discard(work, "photos")
    assert os.listdir(tmp_path) == []


def test_publishing_leaves_what_the_user_put_beside_it(out: Path) -> None:
    work = unfinished(out, NEW)
    write(work, {"notes.txt": "mine"})
    publish(work, out)
    assert contents(out) == NEW | {f"{UNFINISHED}/notes.txt": "mine"}
    publish(unfinished(out, OLD), out)  # and the folder is used again
    assert contents(out) == OLD | {f"{UNFINISHED}/notes.txt": "mine"}


def test_two_kinds_are_published_together(out: Path) -> None:
    replace_all(out, {"images/1.png": "old"}, "photos")
    work = unfinished(out, {"images/0.png": "new"}, "photos")
    complete(out)
    assert not (out / "images" / "0.png").exists()  # they wait
    publish(unfinished(out, NEW), out)
    assert contents(out) == NEW | {"images/0.png": "new"}
    assert not work.exists()


def _publish(out: Path) -> None:
    with replacing(out, "demo", all_former=True) as new:
        write(new, NEW)


def _finish(out: Path) -> None:
    """Photos that wait, and a fit that takes its place with them."""
    unfinished(out, {"images/0.png": "new"}, "photos")
    publish(unfinished(out, NEW), out)


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
        for kind in ("demo", "photos"):
            discard(out / UNFINISHED, kind)
        now = contents(out)
        assert now.pop("mine.txt") == "mine"
        assert now in (OLD, new), kill_at
        left_over = [path for path in out.iterdir() if path.is_dir() and path.name not in ("test", "images")]
        assert left_over == [], kill_at
        check_free(out, "demo", [name for name in now if name != "images/0.png"])  # kgs knows its files
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
        '{"files": {"demo": {"a.txt": ["of a former version"]}}}',
        '{"demo": {"a.txt": "3"}}',
        '{"my": "notes"}',
        *(f'{{"files": {{"demo": {{"{name}": ""}}}}}}' for name in ("../a", "/a", "b/../../a", "", ".")),
        None,  # a folder
    ],
)
def test_what_is_no_marker_is_refused_and_stays(out: Path, content: str | None) -> None:
    (out / MARKER).unlink()
    write(out, {f"{MARKER}/notes.txt": "mine"} if content is None else {MARKER: content})
    for act in (lambda: check_free(out, "demo", NEW), lambda: replace_all(out, NEW), lambda: is_own(out, "a.txt")):
        with pytest.raises(
            DataError, match="expected a marker of this version of kgs, got another file: remove it, or choose another"
        ) as error:
            act()
        assert error.value.path == out / MARKER
    assert contents(out) == OLD | ({f"{MARKER}/notes.txt": "mine"} if content is None else {})
    assert content is None or (out / MARKER).read_text() == content


def test_a_marker_that_is_a_link_is_refused(out: Path, tmp_path: Path) -> None:
    """As in a farm of links: the other folder's marker stays."""
    farm = tmp_path / "farm"
    farm.mkdir()
    (farm / MARKER).symlink_to(out / MARKER)
    before = (out / MARKER).read_bytes()
    with pytest.raises(DataError, match="expected a marker"):
        replace_all(farm, NEW)
    assert (out / MARKER).read_bytes() == before


@pytest.mark.parametrize("name", [".kgs-notes", ".kgs-venv", f".kgs-{'0' * 31}", f"{UNFINISHED}-1"])
def test_folders_that_are_only_called_like_those_of_kgs_stay(out: Path, name: str) -> None:
    """Also copies of such, with the marker in them."""
    unfinished(out, {"a.txt": "new"}).rename(out / name)
    (out / f"{name}-empty").mkdir()
    replace_all(out, NEW)
    assert contents(out / name) == {"a.txt": "new"}
    assert (out / f"{name}-empty").is_dir()


def test_a_folder_that_cannot_be_written_to_is_left_as_it_is(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that only read open it, and go on."""
    work = unfinished(out, NEW)
    with monkeypatch.context() as patch, suppress(KeyboardInterrupt):
        patch.setattr(publishing, "complete", partial(kill, KeyboardInterrupt()))
        publish(work, out)
    before = contents(out)
    with monkeypatch.context() as patch:
        patch.setattr(os, "access", lambda *_: False)
        complete(out)
    assert contents(out) == before
    complete(out)
    assert contents(out) == NEW


def kill(error: BaseException, *_: Any, **__: Any) -> None:
    raise error


@pytest.mark.parametrize("has_locks", [True, False])
def test_a_folder_at_work_is_not_taken_for_an_abandoned_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_locks: bool
) -> None:
    if not has_locks:
        pytest.importorskip("fcntl")
        monkeypatch.setattr("fcntl.flock", partial(kill, OSError(errno.ENOLCK, "No locks available")))
    with replacing(tmp_path, "page") as outer:
        with replacing(tmp_path, "page") as inner:
            write(inner, {"b.html": "new"})
        write(outer, {"a.html": "new"})
    assert contents(tmp_path) == {"a.html": "new", "b.html": "new"}


@pytest.mark.parametrize("move", ["all", {}, None])
def test_a_damaged_move_removes_nothing(out: Path, move: Any) -> None:
    write(out, {f"{UNFINISHED}/thesis.txt": "mine"})
    write_json(out / UNFINISHED / MARKER, {"files": {}, "move": move})
    complete(out)
    assert contents(out) == OLD | {f"{UNFINISHED}/thesis.txt": "mine"}


@pytest.mark.parametrize("name", ["speed", "precision", "extremes"])
def test_benchmarks_follow_the_same_rules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(f"kgs.bench.{name}.{name}", lambda out, **_: (out / f"{name}.md").write_text("new") and 0)
    out = tmp_path / "new"
    for _ in range(2):
        assert run("bench", name, "-o", out) == 0
    assert contents(out) == {f"{name}.md": "new"}


BY = "--by 0,0,0 1,0,0 2"


@pytest.mark.parametrize("is_of_another_command", [False, True])
@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("fit {scene} -o {out}", "splat.ply"),
        ("demo -o {out} --size 32", "splat.ply"),
        ("export {fit}/splat.ply -o {out}/a.ply", "a.ply"),
        ("clean {fit}/splat.ply -o {out}/a.ply", "a.ply"),
        (f"scale {{fit}}/splat.ply {BY} -o {{out}}/a.ply", "a.ply"),
        (f"scale {{fit}} {BY} -o {{out}}", "splat.ply"),
        ("page {fit}/splat.ply --cameras {scene} -o {out}/a.html", "a.html"),
        ("render {fit}/splat.ply --cameras {scene} -o {out}", "train_r_0.png"),
        *((f"bench {name} -o {{out}}", f"{name}.md") for name in ("speed", "precision", "extremes")),
    ],
)
def test_no_command_replaces_a_file_of_the_user_or_of_another_command(
    folder: Path, fitted: Path, tmp_path: Path, capsys: Any, words: str, name: str, is_of_another_command: bool
) -> None:
    if is_of_another_command:
        with replacing(tmp_path, "other") as new:
            write(new, {name: "mine"})
    else:
        write(tmp_path, {name: "mine"})
    given = [word.format(scene=folder, fit=fitted, out=tmp_path) for word in words.split()]
    assert run(*given) == 3
    assert f"nothing that this command did not write, or that was changed since, got {name}" in one_line(capsys)
    assert contents(tmp_path) == {name: "mine"}
