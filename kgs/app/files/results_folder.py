"""The files of a fit: which names they have, and how far the fit in a folder is."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from kgs._support.errors import DataError
from kgs._support.json_files import read_json

from .outputs import EXPORTS
from .publishing import UNFINISHED, check_free, discard

CHECKPOINT = "checkpoint.safetensors"
PREVIOUS = "checkpoint.previous.safetensors"
SPLAT_FILES = ("splat.ply", "index.html", *EXPORTS)
FIT_FILES = (*SPLAT_FILES, "config.json", "metrics.json", "curve.png")


def check_fit_files(out: Path, resume: bool, others: Iterable[str] = ()) -> None:
    """Raise a DataError if a fit would replace files that no fit wrote, or an unfinished fit without `resume`.

    `others` are names of results beside those that each fit writes.
    """
    work = out / UNFINISHED
    names = (*FIT_FILES, *others)
    is_folder = work.is_dir() and not work.is_symlink()
    check_free(out, "fit", (*names, CHECKPOINT, PREVIOUS, *([] if is_folder else [UNFINISHED])))
    check_free(work, "fit", names)
    if not resume:
        check_no_fit(work)


def check_no_fit(work: Path) -> None:
    """Raise a DataError if a folder has a fit that is not done."""
    if has_fit(work):
        advice = "go on with it by --resume, or remove this folder"
        raise DataError(work, "", "a fit that is done", "one that is not", advice=advice)


def has_fit(folder: Path) -> bool:
    """Whether a fit in this folder can be resumed."""
    return any((folder / name).exists() for name in (CHECKPOINT, PREVIOUS))


def begun_on_cpu(out: Path) -> bool:
    """Whether the fit that would be resumed in this folder is one on a CPU; False where that is not known."""
    former = next((folder for folder in (out / UNFINISHED, out) if has_fit(folder)), out)
    try:
        return str(read_json(former / "config.json")["fit"]["device"]).startswith("cpu")
    except (DataError, KeyError, TypeError):
        return False


def is_finished(out: Path) -> bool:
    """Whether the folder has the results of a fit that did all its steps."""
    try:
        return bool(read_json(out / "metrics.json")["steps"] >= read_json(out / "config.json")["schedule"]["steps"])
    except (DataError, KeyError, TypeError):
        return False


def step_of(folder: Path) -> int:
    """How many steps the fit in a folder did, by its results or its checkpoint; -1 if it has neither."""
    from kgs.fit.checkpoint import newest_checkpoint  # here, because it loads torch

    steps = [-1]
    with suppress(DataError, KeyError, TypeError, ValueError):
        steps.append(int(read_json(folder / "metrics.json")["steps"]))
    with suppress(DataError, KeyError, TypeError, ValueError):
        steps.append(int(newest_checkpoint(folder / CHECKPOINT)[0]["step"]))
    return max(steps)


def discard_fit(work: Path) -> None:
    """Remove a fit that was not published; files that kgs does not know stay."""
    discard(work, "fit", (CHECKPOINT, PREVIOUS, f"{CHECKPOINT}.partial"))
