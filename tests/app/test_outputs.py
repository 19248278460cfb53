"""Files for the user: names of their own, the list by which kgs knows its own files, and nothing of the user's lost."""

import json
import os
from contextlib import suppress
from functools import partial
from pathlib import Path

import cv2
import pytest
import torch

from kgs.app.files import ownership
from kgs.app.files.outputs import check_folder, png_names, write_png
from kgs.app.files.ownership import LIST, holds_only_own, is_own, read_list, writing
from kgs.app.files.staging import Staging
from kgs.errors import DataError
from kgs.json_files import write_json, write_whole


def test_each_view_has_a_picture_of_its_own():
    views = ["v.png", "v.bmp", "V.PNG", "images/v.png", "images_v.png", "é.png", "e\u0301.png", ".hidden", "a\nb.png"]
    views += [f"{'folder' * 25}/{'x' * 130}{k}.png" for k in range(3)] + ["漢" * 200, "..\\up.jpg", "\udcff.jpg"]
    names = list(png_names(views).values())
    assert len({name.casefold() for name in names}) == len(views)
    assert all(name.endswith(".png") and len(os.fsencode(name)) <= 200 for name in names)
    assert not any(set(name) & set("/\\\n\0") for name in names)
    assert png_names(views) == dict(zip(views, names, strict=True))  # the same again
    plain = ["test/r_0", "IMG_1.JPG", "images/v.1.png"]
    assert list(png_names(plain).values()) == ["test_r_0.png", "IMG_1.png", "images_v.1.png"]


def test_a_png_keeps_its_pixels_also_under_a_long_name(tmp_path):
    image = torch.arange(60).reshape(3, 4, 5) / 255
    (name,) = png_names([f"{'x' * 130}/{'y' * 130}.png"]).values()
    write_png(tmp_path / name, image)
    pixels = cv2.cvtColor(cv2.imread(str(tmp_path / name)), cv2.COLOR_BGR2RGB)
    assert torch.equal(torch.from_numpy(pixels).permute(2, 0, 1), (image * 255).round().byte())


# -- the list of own files -------------------------------------------------------------------------------------------


@pytest.fixture
def listed(tmp_path):
    """A folder whose list has `a.txt` and `deeper/b.txt`."""
    (tmp_path / "deeper").mkdir()
    for name in ("a.txt", "deeper/b.txt"):
        (tmp_path / name).write_text("kgs")
    with writing(tmp_path, "fit", ["a.txt", "deeper/b.txt"]):
        pass
    return tmp_path


def test_what_is_in_the_list_is_own_and_nothing_else(listed, monkeypatch):
    (listed / "mine.txt").write_text("mine")
    monkeypatch.chdir(listed)
    assert is_own(listed / "a.txt")
    assert is_own(listed / "deeper" / "b.txt")
    assert is_own(Path("deeper/b.txt"))
    assert not is_own(listed / "mine.txt")
    assert not is_own(listed / "none.txt")
    assert holds_only_own(listed / "deeper")
    assert not holds_only_own(listed)


@pytest.mark.parametrize("change", ["content", "time", "link"])
def test_an_own_file_that_was_changed_is_the_users(listed, change):
    path = listed / "a.txt"
    if change == "content":
        path.write_text("mine, longer")
    elif change == "time":
        os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
    else:
        path.rename(listed / "other.txt")
        (listed / "photo").write_text("mine")
        path.symlink_to(listed / "photo")
    assert not is_own(path)
    with pytest.raises(DataError, match="was not written by kgs"):
        check_folder(listed, ["a.txt"])
    assert is_own(listed / "deeper" / "b.txt")


def test_what_is_about_to_be_written_is_own_and_kinds_do_not_touch_each_other(listed):
    with writing(listed, "renders", ["a.txt", "new.png"]):
        write_png(listed / "new.png", torch.zeros(3, 4, 5))
        assert is_own(listed / "new.png")  # a kill may come now
    (listed / "new.png").write_text("mine")
    assert not is_own(listed / "new.png")
    assert set(read_list(listed)["fit"]) == {"a.txt", "deeper/b.txt"}


def test_what_a_command_that_failed_did_not_write_is_not_own(listed):
    with suppress(KeyboardInterrupt), writing(listed, "renders", ["0.png", "1.png"]):
        write_png(listed / "0.png", torch.zeros(3, 4, 5))
        raise KeyboardInterrupt
    (listed / "1.png").write_text("mine")
    assert is_own(listed / "0.png")
    assert not is_own(listed / "1.png")


def test_a_list_is_read_once_for_all_its_files(tmp_path, monkeypatch):
    """A folder may have thousands of renders."""
    reads = []
    plain = ownership.read_json
    monkeypatch.setattr(ownership, "read_json", lambda path: reads.append(path) or plain(path))
    names = [f"{i}.png" for i in range(50)]
    for name in names:
        (tmp_path / name).touch()
    with writing(tmp_path, "renders", names):
        pass
    reads.clear()
    check_folder(tmp_path, names)
    assert len(reads) == 1
    with writing(tmp_path, "fit", []):
        pass
    assert read_list(tmp_path)["fit"] == {}


@pytest.mark.parametrize("content", ["", "[]", "null", '{"fit": 3}', '{"fit": {"a.txt": 3}}'])
def test_a_damaged_list_names_nothing(listed, content):
    (listed / LIST).write_text(content)
    assert not is_own(listed / "a.txt")


@pytest.mark.parametrize("name", ["../mine.txt", "{}/mine.txt", "deeper/../../mine.txt", "", ".", "deeper"])
def test_a_list_that_names_more_than_files_below_its_folder_removes_nothing_else(tmp_path, name):
    out = tmp_path / "out"
    (out / "deeper").mkdir(parents=True)
    (tmp_path / "mine.txt").write_text("mine")
    write_json(out / LIST, {"fit": {name.format(tmp_path): None}})
    write_results(Staging(out), {"a.txt": "new"})
    Staging(out).complete()
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert contents(out) == {"a.txt": "new"}


def write_results(staging, files):
    """Write and seal results."""
    staging.start()
    for name, text in files.items():
        (staging.unfinished / name).parent.mkdir(exist_ok=True)
        (staging.unfinished / name).write_text(text)
    staging.seal()


def contents(folder):
    """The texts of all files that are not hidden."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name[0] != "."]
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def test_a_kill_at_any_call_leaves_old_or_new_results(tmp_path, monkeypatch):
    old = {"a.txt": "old", "test/0.txt": "old", "test/1.txt": "old"}
    new = {"a.txt": "new", "b.txt": "new", "test/0.txt": "new"}
    steps = ("mkdir", "replace", "rmdir", "unlink")
    plain = {name: getattr(os, name) for name in steps}
    calls = 0
    kill_at = 0
    found = []
    is_done = False

    def until_killed(name, *arguments, **options):
        nonlocal calls
        calls += 1
        if calls > kill_at:
            raise KeyboardInterrupt
        return plain[name](*arguments, **options)

    while not is_done:
        staging = Staging(tmp_path / str(kill_at))
        write_results(staging, old)
        staging.complete()
        (staging.unfinished / "test").mkdir(parents=True)
        for name in (LIST, "test/0.txt"):
            (staging.unfinished / name).write_text("{}")  # of a fit that was killed
        calls = 0
        with monkeypatch.context() as patch:
            for name in steps:
                patch.setattr(os, name, partial(until_killed, name))
            try:
                write_results(staging, new)
                staging.complete()
                is_done = True
            except KeyboardInterrupt:
                is_done = False
        for folder in (staging.unfinished, staging.finished):
            assert not folder.exists() or is_own(folder), kill_at
        moved = [staging.out / name for name in old | new if (staging.out / name).exists()]
        assert all(map(is_own, moved)), kill_at
        staging.complete()
        assert not staging.finished.exists()
        staging.start()
        now = contents(staging.out)
        assert now in (old, new), kill_at
        found.append(now)
        kill_at += 1
    first_new = found.index(new)
    assert first_new > 0
    assert found[first_new:] == [new] * (len(found) - first_new)


def test_a_kill_while_waiting_results_are_discarded_does_not_publish_half_of_them(tmp_path, monkeypatch):
    staging = Staging(tmp_path, "photos")
    write_results(staging, {"a.txt": "old", "b.txt": "old"})
    staging.complete()
    write_results(staging, {"a.txt": "new", "b.txt": "new"})
    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", lambda *_, **__: (staging.finished / "a.txt").unlink(missing_ok=True))
        staging.discard()
    assert staging.finished.exists()
    staging.complete()
    assert (tmp_path / "a.txt").read_text() == (tmp_path / "b.txt").read_text() == "old"


def test_a_picture_with_a_hidden_name_is_kept(tmp_path):
    write_results(Staging(tmp_path), {"test/.0.png": "picture"})
    Staging(tmp_path).complete()
    assert (tmp_path / "test" / ".0.png").exists()


def test_a_folder_is_own_with_a_list_or_empty(tmp_path):
    (tmp_path / "empty").mkdir()
    Staging(tmp_path).start()
    (tmp_path / "finished").mkdir()
    (tmp_path / "finished" / "thesis.txt").write_text("mine")
    assert is_own(tmp_path / "empty")
    assert is_own(tmp_path / "unfinished")
    assert not is_own(tmp_path / "finished")


@pytest.mark.parametrize("name", ["splat.ply", "curve.png", "test", "test/a.png", "a link"])
def test_a_users_file_is_never_overwritten(tmp_path, name):
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    if name == "a link":
        (tmp_path / "splat.ply").symlink_to(mine)
    with pytest.raises(DataError, match="was not written by kgs"):
        check_folder(tmp_path, ["splat.ply", "curve.png", "test/a.png"])
    assert mine.read_text() == "mine"


def test_no_results_among_the_files_of_a_scene(tmp_path):
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    (scene / "poses_bounds.npy").write_bytes(b"")
    (scene / "images" / "photo.JPG").write_bytes(b"")
    for out in (scene, scene / "images", tmp_path / "." / "scene" / "images"):
        with pytest.raises(DataError, match="holds files of a scene"):
            check_folder(out, ["other.png"], scene)
    with pytest.raises(DataError, match="holds files of a scene"):
        check_folder(scene, ["other.png"], tmp_path / "another scene")
    check_folder(scene / "results", ["a.png"], scene)
    write_png(scene / "results" / "a.png", torch.zeros(3, 4, 5))
    with writing(scene / "results", "renders", ["a.png"]):
        pass
    check_folder(scene / "results", ["a.png"], scene)  # again: those pictures are kgs's


@pytest.mark.parametrize("name", ["file", "file/below", "file/below/that", "dangling"])
def test_a_folder_that_cannot_be_is_found_at_once(tmp_path, name):
    (tmp_path / "file").write_text("")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    with pytest.raises(DataError, match="expected a folder for results"):
        check_folder(tmp_path / name, [])


def test_a_folder_without_permission_is_found_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda *_: False)  # tests may run as root, who has every permission
    with pytest.raises(DataError, match="no permission for"):
        check_folder(tmp_path / "new", [])


def test_looking_makes_nothing(tmp_path):
    check_folder(tmp_path / "new" / "folder", ["a.png"], make=False)
    assert os.listdir(tmp_path) == []
    check_folder(tmp_path / "new" / "folder", ["a.png"])
    assert os.listdir(tmp_path / "new") == ["folder"]


def test_files_are_whole_or_as_they_were(tmp_path, monkeypatch):
    write_json(tmp_path / "a.json", {"a": 1})
    (tmp_path / "link.json").symlink_to(tmp_path / "a.json")
    write_json(tmp_path / "link.json", {"a": 2})
    assert (tmp_path / "link.json").is_symlink()
    assert json.loads((tmp_path / "a.json").read_text())["a"] == 2
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"a": float("nan")})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.json'"):
        write_whole(tmp_path / "a.json", b"{}")
    assert sorted(os.listdir(tmp_path)) == ["a.json", "link.json"]
    assert json.loads((tmp_path / "a.json").read_text())["a"] == 2
