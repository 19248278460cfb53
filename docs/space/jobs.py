"""From photos to a page for people whom nobody knows: limits, a queue, and the command in a process that can be ended.

Nothing of the web is in here; `app.py` shows it.
"""

import atexit
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from PIL import Image

with suppress(ImportError):  # the extra heic
    from pi_heif import register_heif_opener

    register_heif_opener()

KGS = (sys.executable, "-P", "-c", "from kgs.cli import main; main()", "fit")  # -P: no module from a job's folder
KINDS = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "WEBP": ".webp", "HEIF": ".heic"}  # by Pillow's names
RESULTS = ("index.html", "splat.ply", "turntable.mp4", "turntable.webm")


@dataclass(frozen=True)
class Limits:
    """What one visitor may take of the machine."""

    photos: tuple[int, int] = (3, 12)  # at least, at most
    photo_bytes: int = 30 * 2**20
    all_bytes: int = 200 * 2**20
    pixels: int = 64_000_000  # of one photo
    seconds: float = 20 * 60  # of a job
    waiting: int = 3  # jobs beside the one that runs: the last waits an hour at most
    absent: float = 60  # seconds after which a job that nobody looks at is ended
    kept: float = 3600  # seconds that uploads and results stay on the disk
    disk: int = 8 * 2**30  # bytes of all uploads and results together


class Refused(Exception):
    """The text says to the visitor why, and what to do."""


@dataclass
class Look:
    """A job as it is now."""

    text: str
    done: bool = False
    results: list[Path] = field(default_factory=list)


class Job:
    """The photos of one visitor in a folder of their own, and what became of them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seen = time.monotonic()  # when somebody asked for it
        self.end = ""  # how it ended; empty before

    def log(self) -> str:
        """The end of what the command said: of each stage its last line, no suggestions of further commands."""
        with suppress(OSError), open(self.folder / "log", "rb") as file:
            file.seek(max(0, os.path.getsize(file.name) - 8000))
            text = file.read().decode("utf-8", "replace").partition("\nnext:\n")[0].rstrip()
            return "\n".join(re.sub(r"^(.+: )\d+ of \d+ .*\n(?=\1\d+ of )", "", text, flags=re.M).splitlines()[-20:])
        return ""


class Workshop:
    """Does one job at a time; others wait in a row.

    Args:
        root: folder of folders that hold nothing but what visitors bring and get: what lies in one of them too long is
            removed. Jobs are in `root/jobs`.
        limits: what each of them may take.
        command: words of the process, to which `photos -o out` is added. Nothing that a visitor says becomes a word.
    """

    def __init__(self, root: Path, limits: Limits | None = None, command: Sequence[str] = KGS) -> None:
        self.root, self.limits, self.command = root, limits or Limits(), command
        self.jobs: list[Job] = []  # the first is worked on
        self.change = threading.Condition()
        self.process: subprocess.Popen[bytes] | None = None
        self.closed = False
        (root / "jobs").mkdir(parents=True, exist_ok=True)
        atexit.register(self.close)
        threading.Thread(target=self._work, daemon=True).start()

    def start(self, photos: Sequence[Path]) -> Job:
        """Put a copy of these photos at the end of the row.

        Raises:
            Refused: they are not within the limits, or too many wait already.
        """
        photos = sorted(photos, key=lambda photo: photo.name)
        names = checked(photos, self.limits)
        job = Job(Path(tempfile.mkdtemp(dir=self.root / "jobs")))
        try:
            (job.folder / "photos").mkdir()
            for photo, name in zip(photos, names, strict=True):
                shutil.copyfile(photo, job.folder / "photos" / name)
            with self.change:
                if len(self._row()) > self.limits.waiting:
                    raise Refused(f"{self.limits.waiting} others wait already. Please come back in some minutes.")
                self.jobs.append(job)
                self.change.notify_all()
        except BaseException:
            shutil.rmtree(job.folder, ignore_errors=True)
            raise
        return job

    def look(self, job: Job) -> Look:
        """What there is to tell of a job. One that nobody looks at any more is ended."""
        with self.change:
            job.seen = time.monotonic()
            row = self._row()
            before = row.index(job) if job in row else 0
        if job.end or job not in row:
            results = [job.folder / "out" / name for name in RESULTS] if job.end == "Done." else []
            text = "\n\n".join(filter(None, (job.log(), job.end or "This job was ended.")))
            return Look(text, True, [path for path in results if path.is_file()])
        if before:
            return Look(f"Waiting: one job runs at a time, and {before} come{'s' * (before == 1)} before yours.")
        return Look(job.log() or "The work begins.")

    def leave(self, job: Job) -> None:
        """End a job, if it still runs, and remove what it wrote."""
        with self.change:
            job.seen = float("-inf")
            running = self.jobs[:1] == [job]
        if not running:  # else the worker removes it
            shutil.rmtree(job.folder, ignore_errors=True)

    def close(self) -> None:
        """End the job that runs, and take no more."""
        with self.change:
            self.closed = True
            self.change.notify_all()
        self._kill()

    def _is_left(self, job: Job) -> bool:
        return self.closed or time.monotonic() - job.seen > self.limits.absent

    def _row(self) -> list[Job]:
        """The job that runs and those that still wait, without those whose visitors left."""
        self.jobs[1:] = [job for job in self.jobs[1:] if not self._is_left(job)]
        return self.jobs

    def _kill(self) -> None:
        """The command and whatever it started."""
        process, self.process = self.process, None
        if process is not None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _work(self) -> None:
        while not self.closed:
            with self.change:
                if not self.change.wait_for(lambda: self.jobs or self.closed, timeout=600) or self.closed:
                    self._sweep()
                    continue
                job = self.jobs[0]
            try:
                end = self._run(job)
            except Exception:  # the next one shall not wait for ever
                logging.exception("a job could not be run")
                end = "No page was made: something is wrong with this server."
            shutil.rmtree(job.folder / "photos", ignore_errors=True)  # they have done their work
            with self.change:
                job.end = end
                self.jobs.remove(job)
                gone = job.seen == float("-inf")
            if gone:
                shutil.rmtree(job.folder, ignore_errors=True)
            self._sweep()

    def _sweep(self) -> None:
        with suppress(OSError):  # others write and remove here, too
            sweep(self.root, self.limits, [job.folder for job in self.jobs])

    def _run(self, job: Job) -> str:
        """Run the command; returns how it ended."""
        if self._is_left(job):
            return "This job was ended, because its page was closed."
        late = time.monotonic() + self.limits.seconds
        try:
            with open(job.folder / "log", "wb") as log:
                self.process = process = subprocess.Popen(
                    [*self.command, "photos", "-o", "out"],
                    cwd=job.folder,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # a process group of its own
                )
            while process.poll() is None:
                if time.monotonic() > late:
                    minutes = f"{self.limits.seconds / 60:.0f} minutes"
                    return f"Stopped: a job may take {minutes}. Fewer or smaller photos take less time."
                if self._is_left(job):
                    return "This job was ended, because its page was closed."
                time.sleep(0.05)
            code = process.returncode
        finally:
            self._kill()
        if code == 0:
            return "Done."
        why = "the reason is above" if code > 0 else "it was killed, perhaps because it needed too much memory"
        return f"No page was made: {why}."


def checked(photos: Sequence[Path], limits: Limits) -> list[str]:
    """The names that these photos get in the job's folder: a number, letters of their own name, the kind that they are.

    Raises:
        Refused: too few, too many, too large, or no photos.
    """
    least, most = limits.photos
    if not least <= len(photos) <= most:
        raise Refused(f"Expected {least} to {most} photos, got {len(photos)}.")
    names, total = [], 0
    for number, photo in enumerate(photos, 1):
        stem = re.sub(r"[^A-Za-z0-9]+", "-", photo.stem).strip("-")[:40]
        shown = f"Photo {number} ({stem})" if stem else f"Photo {number}"
        try:
            size = photo.stat().st_size
        except OSError:
            raise Refused(f"{shown} is no longer here. Please upload the photos again.") from None
        if size > limits.photo_bytes:
            raise Refused(f"{shown} has {_megabytes(size)}. A photo may have {_megabytes(limits.photo_bytes)}.")
        total += size
        kind, width, height = _header(photo, shown)
        if kind not in KINDS:
            raise Refused(f"{shown} is no photo that can be read here. Expected JPEG, PNG, WebP or HEIC.")
        if width * height > limits.pixels:
            raise Refused(
                f"{shown} has {width}x{height} pixels. Expected at most {limits.pixels / 1e6:.0f} million: "
                "take it with fewer, or shrink it."
            )
        names.append("-".join(filter(None, (f"{number:02}", stem))) + KINDS[kind])
    if total > limits.all_bytes:
        raise Refused(f"The photos have {_megabytes(total)} together. Expected at most {_megabytes(limits.all_bytes)}.")
    return names


def _header(photo: Path, shown: str) -> tuple[str, int, int]:
    """Kind, width and height as the file says; the pixels are not decoded."""
    try:
        with Image.open(photo, formats=[kind for kind in KINDS if kind != "MPO"]) as opened:
            return str(opened.format), *opened.size
    except Image.DecompressionBombError:
        raise Refused(f"{shown} has far too many pixels. Please shrink it.") from None
    except Exception:  # whatever a decoder says of a file that somebody made to confuse it
        return "", 0, 0


def _megabytes(size: int) -> str:
    return f"{size / 2**20:.0f} MB"


def sweep(root: Path, limits: Limits, used: Sequence[Path] = ()) -> None:
    """Remove what lies too long in the folders in this one, and the oldest where it is too much; not what is used."""
    found = []
    for path in root.glob("*/*"):
        with suppress(OSError):  # gone in the meantime
            found.append((path.stat().st_mtime, _bytes(path), path))
    total, oldest = 0, time.time() - limits.kept
    for changed, size, path in sorted(found, reverse=True):
        total += size
        if path not in used and (changed < oldest or total > limits.disk):
            shutil.rmtree(path, ignore_errors=True)
            with suppress(OSError):
                path.unlink()


def _bytes(path: Path) -> int:
    files: Iterable[Path] = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
