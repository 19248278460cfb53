"""A web page around `kgs fit`: photos in, a page to look around in out. gradio's queue runs one job at a time."""

import atexit
import html
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

folder = tempfile.TemporaryDirectory(prefix="kgs-space-")  # removed at the end
ROOT = Path(folder.name)
os.environ["GRADIO_TEMP_DIR"] = str(ROOT / "files")  # where gradio puts uploads and downloads
os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")

import gradio as gr  # noqa: E402, it reads the two lines above
from PIL import Image  # noqa: E402

with suppress(ImportError):  # the extra heic
    from pi_heif import register_heif_opener

    register_heif_opener()

KGS = (sys.executable, "-P", "-c", "from kgs.app.cli import main; main()", "fit")  # -P: no module from a job's folder
KINDS = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "WEBP": ".webp", "HEIF": ".heic"}  # by Pillow's names
RESULTS = ("index.html", "splat.ply", "turntable.mp4", "turntable.webm")
MIN_PHOTOS, MAX_PHOTOS = 3, 12  # photos
MEGABYTES, ALL_MEGABYTES = 30, 200  # of a photo, of all
MEGAPIXELS = 64  # of a photo
MINUTES = 20  # of a job
WAITING = 3  # jobs beside the one that runs
KEPT_MINUTES = 60  # uploads and results

running: set[subprocess.Popen[bytes]] = set()


class Refused(Exception):
    """Photos that are not within the limits; the text is for the visitor."""


def named(photos: Sequence[Path]) -> dict[str, Path]:
    """The photos by the names that they get: a number, letters of their own name, the kind that they are.

    Raises:
        Refused: too few, too many, too large, or no photos.
    """
    if not MIN_PHOTOS <= len(photos) <= MAX_PHOTOS:
        raise Refused(f"Expected {MIN_PHOTOS} to {MAX_PHOTOS} photos, got {len(photos)}.")
    if not all(photo.is_file() for photo in photos):
        raise Refused("A photo is no longer here. Please upload the photos again.")
    if sum(photo.stat().st_size for photo in photos) > ALL_MEGABYTES * 2**20:
        raise Refused(f"Expected photos of at most {ALL_MEGABYTES} MB together.")
    names = {}
    for number, photo in enumerate(sorted(photos, key=lambda photo: photo.name), 1):
        stem = f"{number:02}-" + re.sub(r"[^A-Za-z0-9]+", "-", photo.stem).strip("-")[:40]
        try:
            with Image.open(photo, formats=[kind for kind in KINDS if kind != "MPO"]) as opened:  # the header alone
                kind, (width, height) = opened.format, opened.size
        except Exception as error:  # whatever a decoder says of a file that somebody made to confuse it
            raise Refused(f"Photo {stem} cannot be read. Expected JPEG, PNG, WebP or HEIC.") from error
        if photo.stat().st_size > MEGABYTES * 2**20 or width * height > MEGAPIXELS * 1e6:
            raise Refused(f"Photo {stem} is too large. Expected at most {MEGABYTES} MB and {MEGAPIXELS} megapixels.")
        names[stem + KINDS[str(kind)]] = photo
    return names


def make(photos: list[str] | None, command: Sequence[str] = KGS) -> Iterator[tuple[str, list[str], str]]:
    """What is shown while a visitor waits, and in the end: text, files and the page. Nobody's word is an option."""
    try:
        names = named([Path(photo) for photo in photos or []])
    except Refused as reason:
        yield str(reason), [], ""
        return
    job = Path(tempfile.mkdtemp(dir=ROOT))
    process = None
    try:
        (job / "photos").mkdir()
        for name, photo in names.items():
            shutil.copyfile(photo, job / "photos" / name)
        with open(job / "log", "wb") as log:
            words, nothing = [*command, "photos", "-o", "out"], subprocess.DEVNULL
            process = subprocess.Popen(words, cwd=job, stdin=nothing, stdout=log, stderr=log, start_new_session=True)
        running.add(process)
        end = time.monotonic() + 60 * MINUTES
        while process.poll() is None and time.monotonic() < end:
            yield said(job) or "The work begins.", [], ""
            time.sleep(1)
        if process.returncode is None:
            yield f"{said(job)}\n\nStopped: a job may take {MINUTES} minutes. Take fewer photos.", [], ""
        elif process.returncode != 0:
            why = "the reason is above" if process.returncode > 0 else "it was killed, perhaps for lack of memory"
            yield f"{said(job)}\n\nNo page was made: {why}.", [], ""
        else:
            results = [job / "out" / name for name in RESULTS if (job / "out" / name).is_file()]
            yield f"{said(job)}\n\nDone.", [str(path) for path in results], framed(job / "out" / "index.html")
    finally:  # also where the visitor is gone
        if process is not None:
            kill(process)
        shutil.rmtree(job, ignore_errors=True)


def said(job: Path) -> str:
    """The end of what the command said: of each stage its last line, no suggestions of further commands."""
    text = (job / "log").read_text(encoding="utf-8", errors="replace").partition("\nnext: ")[0].rstrip()
    return "\n".join(re.sub(r"^(.+: )\d+ of \d+ .*\n(?=\1\d+ of )", "", text, flags=re.M).splitlines()[-20:])


def framed(page: Path) -> str:
    """The page in a frame that can run its viewer, and reach nothing outside of itself."""
    text = html.escape(page.read_text(encoding="utf-8"))
    return f'<iframe sandbox="allow-scripts" srcdoc="{text}" style="width: 100%; height: 85vh; border: 0"></iframe>'


def kill(process: subprocess.Popen[bytes]) -> None:
    """The command and whatever it started."""
    running.discard(process)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


ABOUT = f"""
# Photos in, page out

Upload {MIN_PHOTOS} to {MAX_PHOTOS} photos of something that does not move, with a step to the side between them, as
your camera wrote them. You get a page in which you can look around: Gaussian splatting by kgs.

Keep this page open: what nobody waits for is stopped. A job takes some minutes, {MINUTES} at most. Photos and results
are deleted from this server after about {KEPT_MINUTES} minutes.
"""
with gr.Blocks(title="kgs: photos in, page out", delete_cache=(600, 60 * KEPT_MINUTES)) as app:
    gr.Markdown(ABOUT)
    chosen = gr.File(label="Photos", file_count="multiple", file_types=["image", ".heic", ".heif"])
    button = gr.Button("Make the page", variant="primary")
    text = gr.Textbox(label="What happens", lines=8, max_lines=20, interactive=False)
    files = gr.File(label="To keep: the page, the splat, the film", file_count="multiple", interactive=False)
    shown = gr.HTML()
    button.click(make, chosen, [text, files, shown], api_visibility="private", concurrency_limit=1)

if __name__ == "__main__":
    atexit.register(lambda: [kill(process) for process in list(running)])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # so that the job ends and the folder goes there, too
    app.queue(max_size=WAITING).launch(max_file_size=MEGABYTES * 2**20, footer_links=[], ssr_mode=False)
