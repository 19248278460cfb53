"""Steps of pycolmap that write a database, each in a process of its own.

What one of pycolmap's threads raises, on a full disk for one, aborts the process that it is in; and Ctrl-C would wait
until such a step is done. This file is what the process runs: it imports nothing of kgs.
"""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

_PEAK_FACTOR = 0.25  # of COLMAP's contrast threshold for keypoints
_LONGEST = 1000  # pixels; COLMAP's keypoints of photos reduced to this are as good, and take a minute less
_PROBE = 4 * 2**20  # bytes that are written to see whether a disk is full


class PycolmapProcesses:
    """Runs steps, from any thread. The end of the block ends the steps that are still at work."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._at_work = set[subprocess.Popen[str]]()
        self._is_open = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        with self._lock:
            self._is_open = False
            for process in self._at_work:
                process.kill()

    def run(self, step: str, database: Path, **arguments: Any) -> None:
        """Run one of the `STEPS` below, and wait for it. Its arguments go there as JSON.

        Raises:
            OSError: the disk is full.
            MemoryError: the system ended the process, as a rule because memory was short.
            RuntimeError: pycolmap failed for another reason.
        """
        request = json.dumps({"path": sys.path, "step": step, "database": str(database), "arguments": arguments})
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        with subprocess.Popen([sys.executable, "-P", __file__], text=True, errors="replace", **pipes) as process:
            with self._lock:
                self._at_work.add(process)
                if not self._is_open:
                    process.kill()
            try:
                with suppress(BrokenPipeError):  # it was ended
                    print(request, file=process.stdin, flush=True)  # the pipe stays open as long as this process lives
                said = process.stderr.read() if process.stderr else ""
                code = process.wait()
            finally:
                process.kill()
                with self._lock:
                    self._at_work.discard(process)
        if code:
            raise _failure(code, said, database)


def check_space(folder: Path) -> None:
    """Raise an OSError if 4 MiB, which are removed again, find no room in the folder."""
    probe = folder / "probe"
    try:
        with open(probe, "wb") as file:
            file.write(bytes(_PROBE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from error
    finally:
        probe.unlink(missing_ok=True)


def _failure(code: int, said: str, database: Path) -> Exception:
    """The error that says why a step failed: by its exit code, and by what it wrote to stderr."""
    try:
        check_space(database.parent)
    except OSError as error:
        return error
    if "disk is full" in said:  # and has room again
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(database.parent))
    if code == -getattr(signal, "SIGKILL", 0):
        return MemoryError("the matching of photos was ended by the system")
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    reason = next((line.partition(":")[2].strip() for line in lines if line.startswith("what():")), "")
    return RuntimeError(f"pycolmap: {reason or (lines or [f'exit code {code}'])[-1]}")


def _write_colmap_matches(
    database: str, images: str, lenses: list[tuple[list[str], str | None]], masks: str | None, seed: int
) -> None:
    """Write COLMAP's own keypoints and verified matches of photos.

    `lenses` are the names of the photos of each, and the parameters of the SIMPLE_RADIAL lens; None: COLMAP guesses
    them from the files. Masks are named as the photos with .png behind.
    """
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    if masks is not None:
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    extraction.use_gpu = False
    extraction.max_image_size = _LONGEST
    extraction.sift.peak_threshold *= _PEAK_FACTOR
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    matching.use_gpu = False
    for names, lens in lenses:
        reader.camera_params = lens or ""
        pycolmap.extract_features(
            database,
            images,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    pycolmap.match_exhaustive(
        database,
        matching_options=matching,
        verification_options=_two_view_options(seed),
        device=pycolmap.Device.cpu,
    )


def _verify(database: str, seed: int) -> None:
    """Keep the matches of each pair that one motion of the camera explains."""
    import pycolmap

    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = 1
    pycolmap.geometric_verification(database, verifier, two_view_geometry_options=_two_view_options(seed))


def _two_view_options(seed: int) -> Any:
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.detect_watermark = False
    return options


STEPS: dict[str, Callable[..., None]] = {"write_colmap_matches": _write_colmap_matches, "verify": _verify}


def _end_with_the_parent() -> None:
    while sys.stdin.readline():
        pass
    os._exit(1)


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent ends this one
    with suppress(ImportError, ValueError, OSError):
        import resource  # of POSIX alone

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    sys.path[:] = request["path"]
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL)
    STEPS[request["step"]](request["database"], **request["arguments"])


if __name__ == "__main__":
    _main()
