"""The web page around `kgs fit` (docs/space): its limits with quick commands in place of kgs; whole jobs (slow)."""

import importlib
import os
import re
import sys
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from photo_folders import write_planes

pytest.importorskip("PIL")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="the machines that it is for have process groups")

SPACE = Path(__file__).parents[1] / "docs" / "space"
sys.path.insert(0, str(SPACE))
import jobs  # noqa: E402

# What the quick commands do; they get `photos -o out`.
WRITES = "import os; os.mkdir('out'); [open(f'out/{n}', 'w').write('made') for n in ('index.html', 'splat.ply')]"
LISTS = f"import os; print(*sorted(os.listdir('photos'))); {WRITES}; print('next:'); print('kgs render out')"
FAILS = "import sys; print('kgs: photos: two solvers do not agree: <b>step</b> to the side', file=sys.stderr); exit(2)"
SLEEPS = "import time; print('step 1 of 9', flush=True); time.sleep(60)"
# a child that outlives its parent, unless the whole group is killed
HAS_A_CHILD = "import subprocess, sys, time; print(subprocess.Popen(['sleep', '60']).pid, flush=True); time.sleep(60)"


def words(code):
    return (sys.executable, "-S", "-c", code)


@pytest.fixture
def workshop(tmp_path):
    """Makes workshops with quick commands, and closes them."""
    made = []

    def make(code=LISTS, **limits):
        made.append(jobs.Workshop(tmp_path / "root", jobs.Limits(**limits), words(code)))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def photos(tmp_path):
    """Three small photos; more in `numbered`."""
    return numbered(tmp_path / "uploads", 3)


def numbered(folder, count, size=(24, 32)):
    folder.mkdir()
    paths = [folder / f"IMG_{number}.jpg" for number in range(count)]
    for path in paths:
        cv2.imwrite(str(path), np.full((*size, 3), 128, np.uint8))
    return paths


def until(condition, seconds=20):
    """Wait for something that another thread or process does."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)
    return found


def finished(shop, job, seconds=20):
    return until(lambda: (look := shop.look(job)).done and look, seconds)


def is_alive(process):
    """Whether it runs; a zombie does not."""
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False


# -- a job -----------------------------------------------------------------------------------------------------------


def test_photos_go_in_and_files_come_out(workshop, photos):
    shop = workshop()
    look = finished(shop, job := shop.start(photos))
    assert look.text == "01-IMG-0.jpg 02-IMG-1.jpg 03-IMG-2.jpg\n\nDone."  # and no suggestions for a shell
    assert [path.name for path in look.results] == ["index.html", "splat.ply"]
    assert not (job.folder / "photos").exists(), "photos stay no longer than they are needed"
    assert all(photo.exists() for photo in photos), "they belong to who uploaded them"
    shop.leave(job)
    assert not job.folder.exists()


def test_of_each_stage_the_last_line_is_shown(workshop, photos):
    lines = [
        "photos: 1 of 2 photos",
        "photos: 2 of 2 photos",
        "3 photos placed",
        "fit: 1 of 9 steps, 20 dB",
        "fit: 3 of 9 steps",
    ]
    shop = workshop(f"print({chr(10).join(lines)!r})")
    said = finished(shop, shop.start(photos)).text
    assert said == "photos: 2 of 2 photos\n3 photos placed\nfit: 3 of 9 steps\n\nDone."


def test_what_the_command_says_of_photos_is_shown(workshop, photos):
    shop = workshop(FAILS)
    look = finished(shop, shop.start(photos))
    assert look.text.startswith("kgs: photos: two solvers do not agree: <b>step</b> to the side\n")
    assert "No page was made" in look.text
    assert not look.results


def test_a_command_that_is_not_there(tmp_path, photos):
    shop = jobs.Workshop(tmp_path / "root", command=("no-such-command",))
    assert "wrong with this server" in finished(shop, shop.start(photos)).text
    assert "wrong with this server" in finished(shop, shop.start(photos)).text, "it still takes jobs"
    shop.close()


def test_a_command_that_is_killed(workshop, photos):
    shop = workshop("import os; os.kill(os.getpid(), 9)")
    assert "memory" in finished(shop, shop.start(photos)).text


@pytest.mark.parametrize(
    "name", ["-o.jpg", "--config.device cuda.jpg", "a;rm -rf ~.png", "<script>alert(1)<.jpg", "ünï 漢字.jpg", "x" * 200]
)
def test_no_name_becomes_an_option_or_code(workshop, photos, name):
    photos[0] = photos[0].rename(photos[0].with_name(name))
    shop = workshop("import sys; print(sys.argv[1:]); import os; print(*os.listdir('photos'), sep='\\n')")
    said, *names = finished(shop, shop.start(photos)).text.partition("\n\n")[0].splitlines()
    assert said == "['photos', '-o', 'out']"
    assert len(names) == 3
    assert all(re.fullmatch(r"0[1-3](-[A-Za-z0-9-]{1,40})?\.jpg", each) for each in names)


# -- limits of photos ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 2, 13])
def test_too_few_and_too_many_photos(workshop, tmp_path, count):
    with pytest.raises(jobs.Refused, match=f"3 to 12 photos, got {count}"):
        workshop().start(numbered(tmp_path / "uploads", count))
    assert not list((tmp_path / "root" / "jobs").iterdir())


def test_bytes_of_a_photo_and_of_all(workshop, photos):
    size = photos[0].stat().st_size
    with pytest.raises(jobs.Refused, match=r"Photo 1 \(IMG-0\) has 0 MB"):
        workshop(photo_bytes=size - 1).start(photos)
    with pytest.raises(jobs.Refused, match="together"):
        workshop(all_bytes=3 * size - 1).start(photos)
    workshop(photo_bytes=size, all_bytes=3 * size).start(photos)


def test_pixels(workshop, photos):
    with pytest.raises(jobs.Refused, match="32x24 pixels"):
        workshop(pixels=32 * 24 - 1).start(photos)
    workshop(pixels=32 * 24).start(photos)


def test_a_header_that_claims_more_pixels_than_any_photo(workshop, photos):
    data = bytearray(cv2.imencode(".png", np.zeros((4, 4, 3), np.uint8))[1].tobytes())
    data[16:24] = (60000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    photos[1].write_bytes(data)
    with pytest.raises(jobs.Refused, match="Photo 2 .* far too many pixels"):
        workshop().start(photos)


@pytest.mark.parametrize(
    "content", [b"", b"GIF89a" + bytes(40), b"<html><script>alert(1)</script>", b"\xff\xd8\xff", b"%PDF"]
)
def test_what_is_no_photo(workshop, photos, content):
    photos[2].write_bytes(content)
    with pytest.raises(jobs.Refused, match=r"Photo 3 \(IMG-2\) is no photo"):
        workshop().start(photos)


def test_the_kind_is_what_is_in_the_file(workshop, photos):
    photos[0].write_bytes(cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))[1].tobytes())
    photos[1].write_bytes(cv2.imencode(".webp", np.zeros((24, 32, 3), np.uint8))[1].tobytes())
    shop = workshop()
    assert finished(shop, shop.start(photos)).text.startswith("01-IMG-0.png 02-IMG-1.webp 03-IMG-2.jpg\n")


def test_an_upload_that_was_removed_meanwhile(workshop, photos):
    photos[0].unlink()
    with pytest.raises(jobs.Refused, match="upload the photos again"):
        workshop().start(photos)


# -- limits of time --------------------------------------------------------------------------------------------------


def test_a_job_that_takes_too_long_is_ended_with_all_its_processes(workshop, photos):
    shop = workshop(HAS_A_CHILD, seconds=0.5)
    look = finished(shop, shop.start(photos))
    child = int(look.text.split()[0])
    assert "Stopped: a job may take" in look.text
    until(lambda: not is_alive(child))
    assert not look.results


@pytest.mark.parametrize("way", ["leaves", "is not heard of"])
def test_a_job_is_ended_when_its_visitor(workshop, photos, way):
    shop = workshop(HAS_A_CHILD, absent=0.5 if way == "is not heard of" else 60)
    job = shop.start(photos)
    child = int(until(lambda: re.match(r"\d+(?=\n|$)", job.log()))[0])
    if way == "leaves":
        shop.leave(job)
    until(lambda: not shop.jobs)
    until(lambda: not is_alive(child))
    if way == "leaves":
        until(lambda: not job.folder.exists())


def test_one_job_at_a_time_and_the_others_know_their_place(workshop, photos):
    shop = workshop(SLEEPS, waiting=2)
    row = [shop.start(photos) for _ in range(3)]
    until(lambda: shop.look(row[0]).text == "step 1 of 9")
    assert "1 comes before yours" in shop.look(row[1]).text
    assert "2 come before yours" in shop.look(row[2]).text
    assert not (row[1].folder / "log").exists(), "it has not begun"
    with pytest.raises(jobs.Refused, match="2 others wait"):
        shop.start(photos)
    assert len(list((shop.root / "jobs").iterdir())) == 3, "who is refused leaves nothing behind"
    shop.leave(row[1])  # one that waits: the next moves up, and there is a place again
    assert not row[1].folder.exists()
    assert "1 comes before yours" in shop.look(row[2]).text
    row.append(shop.start(photos))
    shop.leave(row[0])  # the one that runs
    until(lambda: shop.look(row[2]).text == "step 1 of 9")
    assert "1 comes before yours" in shop.look(row[3]).text


def test_the_end_of_the_server_is_the_end_of_its_job(workshop, photos):
    shop = workshop(HAS_A_CHILD)
    job = shop.start(photos)
    child = int(until(lambda: re.match(r"\d+(?=\n|$)", job.log()))[0])
    shop.close()
    until(lambda: not is_alive(child))


# -- limits of the disk ----------------------------------------------------------------------------------------------


def entry(root, name, age, size=1):
    folder = root / "uploads" / name
    folder.mkdir(parents=True)
    (folder / "photo.jpg").write_bytes(bytes(size))
    os.utime(folder, (time.time() - age,) * 2)
    return folder


def test_what_is_old_goes_when_a_job_ends(workshop, photos, tmp_path):
    old, new = (entry(tmp_path / "root", name, age) for name, age in (("old", 3700), ("new", 3500)))
    stale = tmp_path / "root" / "uploads" / "stale"
    stale.write_text("a file")
    os.utime(stale, (0, 0))
    shop = workshop()
    job = shop.start(photos)
    os.utime(job.folder, (0, 0))
    finished(shop, job)
    until(lambda: not old.exists() and not stale.exists())
    assert new.exists()


def test_the_oldest_goes_where_it_is_too_much(tmp_path):
    first, second, third = (entry(tmp_path, name, age, 100) for name, age in (("1", 300), ("2", 200), ("3", 100)))
    jobs.sweep(tmp_path, jobs.Limits(disk=250))
    assert [path.exists() for path in (first, second, third)] == [False, True, True]
    jobs.sweep(tmp_path, jobs.Limits(disk=50), used=[third])
    assert [path.exists() for path in (second, third)] == [False, True]


# -- the folder as it is uploaded ------------------------------------------------------------------------------------


def test_the_card_names_what_is_there():
    yaml = pytest.importorskip("yaml")
    card = yaml.safe_load((SPACE / "README.md").read_text(encoding="utf-8").split("---\n")[1])
    assert (SPACE / card["app_file"]).is_file()
    assert f"gradio=={card['sdk_version']}\n" in (SPACE / "requirements.txt").read_text(encoding="utf-8")
    limits = jobs.Limits()
    text = " ".join((SPACE / "README.md").read_text(encoding="utf-8").split())
    said = (
        f"{limits.photo_bytes / 2**20:.0f} MB, {limits.pixels / 1e6:.0f} million pixels; {limits.all_bytes / 2**20:.0f}"
    )
    assert said in text
    assert f"| {limits.seconds / 60:.0f} minutes, then" in text


def test_the_web_page_shows_text_and_the_page_in_a_frame(workshop, photos, monkeypatch):
    pytest.importorskip("gradio")
    monkeypatch.setattr(os, "environ", os.environ.copy())  # it sets some
    app = importlib.import_module("app")
    app.workshop.close()
    refused = list(app.make([str(photos[0])]))
    assert refused == [("Expected 3 to 12 photos, got 1.", [], "")]
    page = """import os; os.mkdir('out'); open('out/index.html', 'w').write('<p title="a">&lt;</p>')"""
    monkeypatch.setattr(app, "workshop", workshop(page))
    said, files, frame = list(app.make(list(map(str, photos))))[-1]
    assert said == "Done."
    assert [Path(file).name for file in files] == ["index.html"]
    assert 'sandbox="allow-scripts"' in frame
    assert 'srcdoc="&lt;p title=&quot;a&quot;&gt;&amp;lt;&lt;/p&gt;"' in frame
    assert not list((app.workshop.root / "jobs").iterdir()), "what was shown is removed"


# -- the real command ------------------------------------------------------------------------------------------------


@pytest.fixture
def kgs_workshop(tmp_path):
    """Makes a workshop with the real command, at a tiny size."""
    pytest.importorskip("pycolmap")
    shop = jobs.Workshop(tmp_path / "root", command=(*jobs.KGS, "--size", "96", "--steps", "30"))
    yield shop
    shop.close()


@pytest.mark.slow
def test_photos_become_a_page(kgs_workshop, tmp_path):
    job = kgs_workshop.start(list(write_planes(tmp_path / "uploads").iterdir()))
    look = finished(kgs_workshop, job, 400)
    assert look.text.endswith("Done."), look.text
    found = [path.name for path in look.results]
    assert found == [name for name in jobs.RESULTS if name in found]
    assert len(found) == len(jobs.RESULTS) - 1  # one film
    assert "01-IMG-1" in look.results[0].read_text(encoding="utf-8")


@pytest.mark.slow
def test_one_photo_three_times_is_refused_with_advice(kgs_workshop, tmp_path):
    first, *others = sorted(write_planes(tmp_path / "uploads").iterdir())
    for other in others:
        other.write_bytes(first.read_bytes())
    job = kgs_workshop.start([first, *others])
    look = finished(kgs_workshop, job, 400)
    assert "kgs: photos" in look.text
    assert "No page was made" in look.text
    assert str(tmp_path) not in look.text
