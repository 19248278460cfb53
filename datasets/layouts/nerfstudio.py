"""Scenes with one `transforms.json`, as nerfstudio and instant-ngp write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kgs.datasets.frames import Frame, FrameSet
from kgs.errors import DataError

from .transforms import find_photo, read_transforms

__all__ = ["load_nerfstudio"]


def load_nerfstudio(root: Path) -> FrameSet:
    """Read `transforms.json`, see :func:`read_transforms`; distorted lenses are undone when photos are read.

    `applied_transform` is not undone: the world is the file's. Where the file has `test_filenames` (or else
    `val_filenames`), these are the test views; training views are those of `train_filenames`, or all others.

    Raises:
        DataError: a file is missing or damaged, or a lens is of a kind that cannot be undone.
    """
    frames, data, notes = read_transforms(root, "transforms.json")
    lists = {key: _listed(root, data, f"{key}_filenames", frames) for key in ("train", "val", "test")}
    held_out = lists["test"] or lists["val"]
    train = lists["train"] or [frame for frame in frames if frame not in [*lists["val"], *held_out]]
    if lists["train"] and not held_out:
        held_out = [frame for frame in frames if frame not in train]
    if not train or (lists["train"] and not held_out):
        raise DataError(root / "transforms.json", "train_filenames", "expected views to train on and others to test on")
    unused = len(frames) - len(train) - len(held_out)
    if held_out and unused > 0:
        notes += (f"transforms.json: {unused} frames are neither training nor test views",)
    return FrameSet(train, held_out or None, notes=notes)


def _listed(root: Path, data: dict[str, Any], key: str, frames: list[Frame]) -> list[Frame]:
    """The frames that a list of file names names, sorted by name."""
    source, names = root / "transforms.json", data.get(key)
    if names is None:
        return []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(source, key, "expected a list of file names")
    by_name = {frame.name: frame for frame in frames}
    found = sorted({find_photo(source, root, name) for name in names})
    missing = [name for name in found if name not in by_name]
    if missing:
        raise DataError(source, key, f"expected names of frames, got {missing[0][:200]!r}")
    return [by_name[name] for name in found]
