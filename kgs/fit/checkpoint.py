"""Checkpoints: files that are whole or absent, verified on loading, without code inside; the last two are kept.

A file is a line "kgs-checkpoint 1 <sha256 of the rest>" followed by what `torch.save` writes.
"""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import Any

import torch

from kgs.errors import DataError

__all__ = ["load_checkpoint", "newest_checkpoint", "previous", "save_checkpoint"]

_MAGIC = b"kgs-checkpoint 1 "


def previous(path: Path) -> Path:
    """Where the checkpoint before the one at `path` is."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write tensors and plain values; the file that was there becomes the previous one.

    Whenever the process dies, `newest_checkpoint` finds the old or the new state.

    Args:
        path: the file.
        state: nested dicts and lists of tensors, numbers, strings and None.

    Raises:
        OSError: the file cannot be written; those that were there are untouched.
    """
    payload = io.BytesIO()
    torch.save(state, payload)
    content = payload.getbuffer()
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            file.write(_MAGIC + hashlib.sha256(content).hexdigest().encode() + b"\n")
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, previous(path))
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def newest_checkpoint(path: Path) -> tuple[dict[str, Any], str]:
    """The newest state that verifies: that at `path`, else the previous one.

    Returns:
        The state, and what is wrong with the newer file: "" where nothing is.

    Raises:
        DataError: neither verifies; it is about the file at `path`.
    """
    try:
        return load_checkpoint(path), ""
    except DataError as error:
        try:
            return load_checkpoint(previous(path)), str(error)
        except DataError:
            raise error from None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote.

    Raises:
        DataError: the file is missing, is no checkpoint, or its content does not match its checksum.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(path, "", f"expected a checkpoint, got {error.strerror}") from error
    head, _, payload = content.partition(b"\n")
    if not head.startswith(_MAGIC):
        raise DataError(path, "header", "expected a checkpoint of kgs, got something else")
    if head[len(_MAGIC) :] != hashlib.sha256(payload).hexdigest().encode():
        raise DataError(path, "sha256", "expected the checksum of the content, got another: the file is damaged")
    state: dict[str, Any] = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    return state


def _sync_folder(folder: Path) -> None:
    """Make the new names survive a power cut, where the system has a way to."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
