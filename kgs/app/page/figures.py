"""The content of metrics.json and config.json as tables and lists of facts, without absolute paths."""

import math
import re
from collections.abc import Mapping
from pathlib import PurePosixPath, PureWindowsPath
from typing import Any

from kgs._support.errors import quantity
from kgs.app.files.plot import PARTS, Runs, with_run
from kgs.metrics.evaluate import brightness_note

# Titles and digits of the measures, by their keys in metrics.json.
MEASURES = {
    "psnr": ("PSNR [dB]", 2),
    "ssim": ("SSIM", 3),
    "ssim_zero_padded": ("SSIM (zero padded)", 3),
    "lpips_vgg": ("LPIPS", 3),
}
# What renders look like whose PSNR is at least this many dB.
_LEVELS = (
    (32.0, "hard to tell from the photos at a glance"),
    (26.0, "close to the photos, without their finest detail"),
    (21.0, "clearly the same scene, soft or wrong in places"),
    (10.0, "recognisable, with large errors"),
    (-math.inf, "not the scene of the photos"),
)
# The folders of a path inside a sentence, if it is absolute or leads out of the folder. Their names may have blanks,
# but not first or last, nor after what ends a path in a sentence: punctuation, or the ending of a file's name.
_FOLDERS = re.compile(
    r"""(?<![\w.:/\\~)\]}]) (?:[A-Za-z]: | ~(?:[A-Za-z_][\w.-]*)? | \.\.)? [\\/]+
    (?: (?!\s) (?: (?! [,;:.)\]'"]\s | \.\w{1,5}\s | :[\\/] ) [^\\/\n] )+ (?<!\s) [\\/] )*
    (?=[^\\/\s])""",
    re.VERBOSE,
)


def without_folders(text: str) -> str:
    """A sentence in which paths that are absolute or lead out of the folder are shortened to their last part.

    In doubt, where a name with blanks could as well be words between two paths, too much is left out, not too little.
    """
    return _FOLDERS.sub("", text)


def facts(values: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Numbers, strings and lists of these as text, by their names; nested dicts are flattened, other values ignored."""
    rows = dict[str, str]()
    for name, value in values.items():
        title = prefix + str(name).replace("_", " ")
        if isinstance(value, Mapping):
            rows.update(facts(value, f"{title}: "))
        elif isinstance(value, list | tuple) and all(isinstance(each, str | int | float) for each in value):
            rows[title] = ", ".join(map(_as_text, value)) or "none"
        elif value is None or isinstance(value, str | int | float):
            rows[title] = _as_text(value)
    return rows


def verdict(runs: Runs) -> str:
    """How good the fit is in a few sentences: by the PSNR of the held-out views, else by that of training views.

    Words follow the PSNR of held-out photos alone, that of the last run with one; see docs/page.md for their limits.
    """
    part = next((part for part in PARTS if any(metrics.get(part) for metrics in runs.values())), None)
    if part is None:
        return ""
    measured = {run: metrics[part] for run, metrics in runs.items() if metrics.get(part)}
    differ = ""
    for run, metrics in runs.items():
        if part == "test" and metrics.get("color_corrected"):
            measured[run] = metrics["color_corrected"]
            differ = f" {brightness_note(dict(metrics))}"
    levels = {run: values["psnr"] for run, values in measured.items() if values.get("psnr") is not None}
    photos = quantity(len(next(iter(measured.values()))["views"]), "photo")
    which = {
        "test": f"{photos} held out of the training",
        "held_out": f"{photos} held out of another fit with the same settings",
        "train": f"the {photos} it was trained on",
        "views": photos,
    }[part]
    text = f"PSNR on {which}: not measured."
    if levels:
        numbers = ", ".join(with_run(f"{level:.1f} dB", run).replace(", ", " ") for run, level in levels.items())
        in_words = next(words for minimum, words in _LEVELS if list(levels.values())[-1] >= minimum)
        words = f", that is {in_words}" if part in ("test", "held_out") else ""
        text = f"PSNR on {which}: {numbers}{words}."
    if part == "held_out":
        return f"{text} This splat was trained on all photos."
    if part != "train":
        return text + differ
    unknown = "No photo was held out, so how good new views are was not measured"
    little = " That says little: it was made to show them." if levels else ""
    return f"{unknown} (kgs fit with --measure or --hold-out does). {text}{little}"


def measure_table(runs: Runs) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table with one row per measure: mean, minimum and maximum over the views of each part."""
    measured = [(run, part, metrics[part]) for run, metrics in runs.items() for part in PARTS if metrics.get(part)]
    head = ["", *(with_run(f"{PARTS[part]} ({len(values['views'])})", run) for run, part, values in measured)]
    rows = list[list[str]]()
    for key, (title, digits) in MEASURES.items():
        cells = [_mean_and_range(values, key, digits) for _, _, values in measured]
        if any(cells):
            rows.append([title, *cells])
    return head, rows


def _mean_and_range(values: Mapping[str, Any], key: str, digits: int) -> str:
    """A measure as "mean (minimum to maximum)", without the range if there is one view; "" if it was not measured."""
    mean = values.get(key)
    if mean is None:
        return ""
    text = f"{mean:.{digits}f}"
    each = [view[key] for view in values["views"] if view.get(key) is not None]
    if len(each) > 1:
        text += f" ({min(each):.{digits}f} to {max(each):.{digits}f})"
    return text


def _as_text(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    is_outside = text.startswith(("~/", "~\\", "../", "..\\"))
    if is_outside or PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute():
        return PureWindowsPath(text).name  # all of it is a path
    return without_folders(text)


def psnr_of_views(metrics: Mapping[str, Any]) -> dict[str, float]:
    """The PSNR of each view that has one, in dB, by the name of the view."""
    parts = [metrics.get(part) or {} for part in ("test", "train", "views")]
    return {row["name"]: row["psnr"] for part in parts for row in part.get("views", []) if row["psnr"] is not None}
