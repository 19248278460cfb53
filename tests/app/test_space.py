"""The web page around `kgs fit` (docs/space): its limits with quick commands in place of kgs; whole jobs (slow)."""

import importlib
import os
import re
import sys
import time
from pathlib import Path
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from photo_folders import write_planes
from tiny_scenes import png_of

pytest.importorskip("PIL")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="the machines that it is for have process groups")

SPACE = Path(__file__).parents[2] / "docs" / "space"

# What the quick commands do; they get `photos -o out`.
WRITES = "import os; os.mkdir('out'); [open(f'out/{n}', 'w').write('<p>') for n in ('index.html', 'splat.ply')]"
LISTS = f"import os; print(*sorted(os.listdir('photos'))); {WRITES}; print('next: kgs render out')"
STAGES = "photos: 1 of 2 photos\nphotos: 2 of 2 photos\n3 photos placed\nfit: 1 of 9 steps, 20 dB\nfit: 3 of 9 steps"
FAILS = "import sys; sys.exit('kgs: photos: two solvers do not agree: <b>step</b> to the side')"
KILLED = "import os; os.kill(os.getpid(), 9)"
# a child that outlives its parent, unless the whole group is killed
HAS_A_CHILD = "import subprocess, sys, time; print(subprocess.Popen(['sleep', '60']).pid, flush=True); time.sleep(60)"


@pytest.fixture
def app(monkeypatch):
    """The module; where gradio is not installed, with a stand-in: what is tested here does not need it."""
    monkeypatch.setattr(os, "environ", os.environ.copy())  # it sets some
    monkeypatch.syspath_prepend(str(SPACE))
    if importlib.util.find_spec("gradio") is None:
        monkeypatch.setitem(sys.modules, "gradio", MagicMock())
    monkeypatch.delitem(sys.modules, "app", raising=False)
    module = importlib.import_module("app")
    monkeypatch.setattr(module.time, "sleep", lambda seconds, sleep=time.sleep: sleep(0.02))
    yield module
    assert not [path for path in module.ROOT.iterdir() if path.name != "files"], "a job leaves files behind"
    module.folder.cleanup()


@pytest.fixture
def photos(tmp_path):
    """Three small photos."""
    return numbered(tmp_path / "uploads", 3)


def numbered(folder, count):
    folder.mkdir()
    paths = [folder / f"IMG_{number}.jpg" for number in range(count)]
    for path in paths:
        cv2.imwrite(str(path), np.full((24, 32, 3), 128, np.uint8))
    return paths


def start(app, photos, code):
    return app.make(list(map(str, photos)), (sys.executable, "-S", "-c", code))


def last(app, photos, code=LISTS):
    return list(start(app, photos, code))[-1]


def is_alive(process):
    """Whether it runs; a zombie does not."""
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


def ends(process, seconds=10):
    """Whether it is over within this time: what was killed needs a moment."""
    end = time.monotonic() + seconds
    while is_alive(process) and time.monotonic() < end:
        pass
    return not is_alive(process)


# -- a job -----------------------------------------------------------------------------------------------------------


def test_photos_go_in_and_a_page_in_a_frame_comes_out(app, photos):
    text, files, frame = last(app, photos)
    assert text == "01-IMG-0.jpg 02-IMG-1.jpg 03-IMG-2.jpg\n\nDone."  # and no suggestions for a shell
    assert [Path(path).name for path in files] == ["index.html", "splat.ply"]
    assert 'sandbox="allow-scripts"' in frame
    assert 'srcdoc="&lt;p&gt;"' in frame
    assert all(photo.exists() for photo in photos), "they belong to who uploaded them"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (f"print({STAGES!r}); {WRITES}", "photos: 2 of 2 photos\n3 photos placed\nfit: 3 of 9 steps\n\nDone."),
        (FAILS, "kgs: photos: two solvers do not agree: <b>step</b> to the side\n\nNo page was made: the reason is"),
        (KILLED, "memory"),
    ],
)
def test_what_the_command_says_is_shown(app, photos, code, said):
    assert said in last(app, photos, code)[0]


@pytest.mark.parametrize(
    "name", ["-o.jpg", "--config.device cuda.jpg", "a;rm -rf ~.png", "<script>alert(1)<.jpg", "ünï 漢字.jpg", "x" * 200]
)
def test_no_name_becomes_an_option_or_code(app, photos, name):
    photos[0] = photos[0].rename(photos[0].with_name(name))
    code = f"import sys; print(sys.argv[1:]); import os; print(*os.listdir('photos'), sep='\\n'); {WRITES}"
    words, *names = last(app, photos, code)[0].partition("\n\n")[0].splitlines()
    assert words == "['photos', '-o', 'out']"
    assert len(names) == 3
    assert all(re.fullmatch(r"0[1-3]-[A-Za-z0-9-]{0,40}\.jpg", each) for each in names)


def test_a_job_that_takes_too_long_is_ended_with_all_its_processes(app, photos, monkeypatch):
    monkeypatch.setattr(app, "MINUTES", 0.5 / 60)
    text, files, _ = last(app, photos, HAS_A_CHILD)
    assert "Stopped: a job may take" in text
    assert not files
    assert ends(int(text.split()[0]))


def test_a_job_is_ended_when_its_visitor_leaves(app, photos):
    job = start(app, photos, HAS_A_CHILD)
    child = next(int(text) for text, *_ in job if text.isdigit())
    assert is_alive(child)
    job.close()
    assert ends(child)
    assert not app.running


# -- limits of photos ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 2, 13])
def test_too_few_and_too_many_photos(app, tmp_path, count):
    assert last(app, numbered(tmp_path / "uploads", count)) == (f"Expected 3 to 12 photos, got {count}.", [], "")


@pytest.mark.parametrize("limit", ["MEGABYTES", "ALL_MEGABYTES", "MEGAPIXELS"])
def test_photos_that_are_too_large(app, photos, monkeypatch, limit):
    monkeypatch.setattr(app, limit, 1e-5)
    assert "Expected " in last(app, photos)[0]


BOMB = png_of(b"", 60_000, 60_000)  # its header claims more pixels than any photo has


@pytest.mark.parametrize(
    "content", [b"", b"GIF89a" + bytes(40), b"<html><script>alert(1)</script>", b"\xff\xd8\xff", BOMB]
)
def test_what_is_no_photo(app, photos, content):
    photos[2].write_bytes(content)
    assert "Photo 03-IMG-2 cannot be read" in last(app, photos)[0]


def test_the_kind_is_what_is_in_the_file(app, photos):
    photos[0].write_bytes(cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes())
    photos[1].write_bytes(cv2.imencode(".webp", np.zeros((24, 32, 3), np.uint8))[1].tobytes())
    assert last(app, photos)[0].startswith("01-IMG-0.png 02-IMG-1.webp 03-IMG-2.jpg\n")


def test_an_upload_that_was_removed_meanwhile(app, photos):
    photos[0].unlink()
    assert "upload the photos again" in last(app, photos)[0]


# -- the folder as it is uploaded ------------------------------------------------------------------------------------


def test_the_card_names_what_is_there(app):
    yaml = pytest.importorskip("yaml")
    text = (SPACE / "README.md").read_text(encoding="utf-8")
    card = yaml.safe_load(text.split("---\n")[1])
    assert (SPACE / card["app_file"]).is_file()
    assert f"gradio=={card['sdk_version']}\n" in (SPACE / "requirements.txt").read_text(encoding="utf-8")
    assert f"{app.MEGABYTES} MB, {app.MEGAPIXELS} megapixels; {app.ALL_MEGABYTES} MB" in text
    assert f"| {app.MINUTES} minutes, then" in text
    assert f"| one at a time, {app.WAITING} wait" in text


# -- the real command ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_photos_become_a_page(app, tmp_path):
    pytest.importorskip("pycolmap")
    photos = map(str, write_planes(tmp_path / "uploads").iterdir())
    text, files, frame = list(app.make(list(photos), (*app.KGS, "--size", "96", "--steps", "30")))[-1]
    assert text.endswith("Done."), text
    assert len(files) == len(app.RESULTS) - 1  # one film
    assert "01-IMG-1" in frame
