"""Checkpoints: one file that is whole or absent, verified on loading, without code inside.

The file is a line "kgs-checkpoint 1 <sha256 of the rest>" followed by what `torch.save` writes.
"""

from __future__ import annotations

import hashlib
import io
import os
from pathlib import Path
from typing import Any

import torch

from kgs.errors import DataError

__all__ = ["load_checkpoint", "save_checkpoint"]

_MAGIC = b"kgs-checkpoint 1 "


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write tensors and plain values; the file at `path` is the old or the new one at every moment.

    Args:
        path: the file.
        state: nested dicts and lists of tensors, numbers, strings and None.
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
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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
