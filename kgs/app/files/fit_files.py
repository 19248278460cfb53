"""The files of a fit: which names they have, and how far the fit in a folder is."""

from contextlib import suppress
from pathlib import Path

from kgs._support.errors import DataError
from kgs._support.json_files import read_json

UNFINISHED = "unfinished"  # the folder of a new fit and its cameras
CHECKPOINT = "checkpoint.safetensors"
PREVIOUS = "checkpoint.previous.safetensors"
FILMS = ("turntable.mp4", "turntable.webm")  # a fit writes one of them
SPLAT_EXPORTS = ("cameras.json", "splat.compressed.ply", "splat.glb")  # for other programs
EXPORTS = (*SPLAT_EXPORTS, "preview.jpg", *FILMS)  # and for messengers
# Patterns of the names in the folder of a fit, by kind: its results, and its photos with their cameras.
NAMES = {
    "fit": (
        *("index.html", "splat.ply", *EXPORTS, "curve.png", "demo.png", "test/*.png"),
        *("metrics.json", "without.json", "config.json", CHECKPOINT, PREVIOUS),
    ),
    "photos": ("photos.json", "transforms.json", "images/*", "masks/*.png", "sparse/0/*"),
}
TEMPORARY = (".kgs-*.tmp", "*/.kgs-*.tmp", "*.partial", "work/*")  # what a kill leaves beside them


def has_fit(folder: Path) -> bool:
    """Whether a fit in this folder can be resumed."""
    return any((folder / name).exists() for name in (CHECKPOINT, PREVIOUS))


def former_fit(out: Path) -> Path | None:
    """The folder of the fit that a resumed one goes on from: the unfinished one, or `out`; None: there is none."""
    return next((folder for folder in (out / UNFINISHED, out) if has_fit(folder)), None)


def begun_on_cpu(out: Path) -> bool:
    """Whether a resumed fit goes on from one on a CPU; False where that is not known."""
    try:
        return str(read_json((former_fit(out) or out) / "config.json")["fit"]["device"]).startswith("cpu")
    except (DataError, KeyError, TypeError):
        return False


def is_finished(folder: Path) -> bool:
    """Whether the folder has the results of a fit that did all its steps."""
    try:
        steps = read_json(folder / "config.json")["schedule"]["steps"]
        return bool(read_json(folder / "metrics.json")["steps"] >= steps)
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
