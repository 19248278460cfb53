"""Checkpoints: safetensors files, written whole or not at all and verified on loading; the last two are kept.

The tensors of a nested dict are stored under their keys joined by "/". Everything else is JSON in the file's metadata
under "state", next to the format and the SHA-256 of tensors and JSON. Loading makes only tensors and plain values.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import reduce
from operator import getitem
from os import PathLike
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from kgs._support.errors import ArgumentError, DataError, quoted
from kgs._support.json_files import parse_json

from .state import digest

_FORMAT = "kgs checkpoint 6"


def previous(path: Path) -> Path:
    """Where the checkpoint before the one at `path` is."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write nested dicts, with text as keys, of tensors and JSON values. The file at `path` becomes the previous one.

    Whenever the process dies, and after an OSError, `newest_checkpoint` finds the old or the new state. Any other value
    is a TypeError, and a plain number that is not finite a ValueError.
    """
    tensors: dict[str, Tensor] = {}
    text = json.dumps(_take_tensors(state, tensors), allow_nan=False, separators=(",", ":"))
    metadata = {"format": _FORMAT, "state": text, "sha256": _digest_all(text, tensors)}
    content = safetensors.torch.save(tensors, metadata)
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, previous(path))
        os.replace(temporary, path)
        if os.name == "posix":  # the new names survive a power cut, where the file system can promise that
            with suppress(OSError):
                _sync_folder(path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def newest_checkpoint(path: Path) -> tuple[dict[str, Any], str]:
    """The state at `path`, or else in the previous file, and what is wrong with the file at `path`, or "".

    If neither can be read the DataError is about the file at `path`.
    """
    try:
        return load_checkpoint(path), ""
    except DataError as error:
        try:
            return load_checkpoint(previous(path)), str(error)
        except DataError:
            raise error from None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote, with tensors on the CPU.

    A DataError if the file is missing, damaged or not a checkpoint, or if a number is not finite.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(path, "", "a checkpoint", advice=f"{error.strerror}") from error
    try:
        tensors = safetensors.torch.load(content)
        metadata = parse_json(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
        if metadata["format"] != _FORMAT:
            raise DataError(path, "format", quoted(_FORMAT), quoted(metadata["format"]))
        if metadata["sha256"] != _digest_all(metadata["state"], tensors):
            raise DataError(path, "sha256", "that of the content", "another", advice="the file is damaged")
        state = parse_json(metadata["state"].encode())
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise DataError(path, name, "finite numbers", "NaN or infinity")
            *folders, key = name.split("/")
            reduce(getitem, folders, state)[key] = tensor.clone()
    except KeyError as error:
        raise DataError(path, str(error.args[0]), "this entry in a checkpoint of kgs", "none") from error
    except (safetensors.SafetensorError, TypeError, ValueError) as error:
        raise DataError(path, "", "a whole checkpoint of kgs", advice=str(error)) from error
    if not isinstance(state, dict):
        raise DataError(path, "state", "a dict", f"a {type(state).__name__}")
    return state


@contextmanager
def errors_of(path: str | PathLike[str]) -> Iterator[None]:
    """Turn an ArgumentError, which names an entry, into an error about this file."""
    try:
        yield
    except ArgumentError as error:
        raise error.about(path) from error


def _digest_all(text: str, tensors: Mapping[str, Tensor]) -> str:
    parts = [text, *(f"{name} {digest(tensors[name])}" for name in sorted(tensors))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _take_tensors(value: Any, tensors: dict[str, Tensor], path: str = "") -> Any:
    """The value without its tensors, which are added to `tensors` under their path."""
    if not isinstance(value, dict):
        return value
    rest = {}
    for key, item in value.items():
        if not isinstance(key, str) or "/" in key:
            raise TypeError(f"state: expected text without '/' as keys, got {key!r}")
        if isinstance(item, Tensor):
            tensor = item.detach().cpu().contiguous()
            others = {other.untyped_storage().data_ptr() for other in tensors.values()}
            is_shared = tensor.untyped_storage().data_ptr() in others  # which safetensors refuses
            tensors[path + key] = tensor.clone() if is_shared else tensor
        else:
            rest[key] = _take_tensors(item, tensors, f"{path}{key}/")
    return rest
