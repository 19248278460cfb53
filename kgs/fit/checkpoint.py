"""Checkpoints: files that are whole or absent, verified on loading, without code inside; the last two are kept.

A file is a line "kgs-checkpoint 2 <sha256 of the rest>", a line of JSON, and the bytes of all tensors one after the
other (little endian). In the JSON a tensor is {"tensor": dtype, "shape": [...]}, a dict {"dict": [[key, value], ...]}
and a tuple {"tuple": [...]}. There is no pickle in it: loading makes tensors and plain values and nothing else.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kgs.errors import DataError
from kgs.json_files import parse_json

__all__ = ["load_checkpoint", "newest_checkpoint", "previous", "save_checkpoint"]

_MAGIC = b"kgs-checkpoint "
_VERSION = b"2 "
_MOST_JSON = 16 * 2**20
_DTYPES = {"uint8": "|u1", "int32": "<i4", "int64": "<i8", "float32": "<f4", "float64": "<f8"}


def previous(path: Path) -> Path:
    """Where the checkpoint before the one at `path` is."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write tensors and plain values; the file that was there becomes the previous one.

    Whenever the process dies, `newest_checkpoint` finds the old or the new state.

    Args:
        path: the file.
        state: nested dicts, lists and tuples of tensors, finite numbers, strings and None.

    Raises:
        OSError: the file cannot be written; those that were there are untouched.
        TypeError: `state` holds something else.
        ValueError: a number outside a tensor is not finite.
    """
    arrays: list[bytes] = []
    description = json.dumps(_describe(state, arrays), allow_nan=False, separators=(",", ":")).encode() + b"\n"
    content = [description, *arrays]
    checksum = hashlib.sha256()
    for part in content:
        checksum.update(part)
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            file.write(_MAGIC + _VERSION + checksum.hexdigest().encode() + b"\n")
            file.writelines(content)
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
    """Read what `save_checkpoint` wrote; tensors come on the CPU.

    Raises:
        DataError: the file is missing, is no checkpoint, its content does not match its checksum, or a number is not
            finite. A right checksum is not taken as proof that the rest is well formed.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(path, "", f"expected a checkpoint, got {error.strerror}") from error
    end = content.find(b"\n", 0, 200)
    head = content[: max(end, 0)]
    if not head.startswith(_MAGIC):
        raise DataError(path, "header", "expected a checkpoint of kgs, got something else")
    if not head.startswith(_MAGIC + _VERSION):
        raise DataError(path, "header", "is a checkpoint of another version of kgs: expected 2, fit again")
    body = memoryview(content)[end + 1 :]
    if head[len(_MAGIC + _VERSION) :] != hashlib.sha256(body).hexdigest().encode():
        raise DataError(path, "sha256", "expected the checksum of the content, got another: the file is damaged")
    split = content.find(b"\n", end + 1, end + 1 + _MOST_JSON)
    if split < 0:
        raise DataError(path, "description", "expected a line of JSON, got no end of it")
    reader = _Reader(memoryview(content)[split + 1 :])
    try:
        state = reader.value(parse_json(content[end + 1 : split]))
        reader.finish()
    except (ValueError, RecursionError) as error:
        raise DataError(path, "description", str(error)) from error
    if not isinstance(state, dict):
        raise DataError(path, "description", f"expected a dict, got a {type(state).__name__}")
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


def _describe(value: Any, arrays: list[bytes]) -> Any:
    """A value as JSON knows it; the tensors' numbers are appended to `arrays`."""
    if isinstance(value, Tensor):
        name = str(value.dtype).removeprefix("torch.")
        if name not in _DTYPES:
            raise TypeError(f"state: expected tensors of {', '.join(_DTYPES)}, got {name}")
        array = value.detach().cpu().contiguous().numpy().astype(_DTYPES[name], copy=False)
        arrays.append(array.tobytes())
        return {"tensor": name, "shape": list(value.shape)}
    if isinstance(value, dict):
        return {"dict": [[key, _describe(item, arrays)] for key, item in value.items()]}
    if isinstance(value, (list, tuple)):
        items = [_describe(item, arrays) for item in value]
        return {"tuple": items} if isinstance(value, tuple) else items
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"state: expected tensors and plain values, got a {type(value).__name__}")


class _Reader:
    """Makes values of a description; each tensor takes the next bytes, so that none is larger than the file."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._at = 0

    def value(self, given: Any) -> Any:
        """The inverse of `_describe`.

        Raises:
            ValueError: the description is none, bytes are missing, or a number is not finite.
        """
        match given:
            case {"tensor": str(name), "shape": list(shape), **more} if not more and name in _DTYPES:
                return self._tensor(name, shape)
            case {"dict": list(pairs), **more} if not more and all(map(_is_pair, pairs)):
                return {key: self.value(item) for key, item in pairs}
            case {"tuple": list(items), **more} if not more:
                return tuple(self.value(item) for item in items)
            case list(items):
                return [self.value(item) for item in items]
            case None | bool() | int() | float() | str():
                return given
        raise ValueError(f"expected a value of a checkpoint, got {str(given)[:80]}")

    def finish(self) -> None:
        """Make sure that nothing is left."""
        if self._at != len(self._data):
            raise ValueError(f"{len(self._data) - self._at} bytes are left over")

    def _tensor(self, name: str, shape: list[Any]) -> Tensor:
        if not all(type(size) is int and 0 <= size < 2**48 for size in shape) or len(shape) > 8:
            raise ValueError(f"expected the shape of a tensor, got {str(shape)[:80]}")
        dtype, count = np.dtype(_DTYPES[name]), math.prod(shape)
        size = count * dtype.itemsize
        if size > len(self._data) - self._at:
            raise ValueError(f"needs {size} bytes for a tensor, the file has {len(self._data) - self._at} more")
        array = np.frombuffer(self._data, dtype, count, self._at).astype(dtype.newbyteorder("="))
        self._at += size
        tensor = torch.from_numpy(array)
        if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
            raise ValueError("expected finite numbers in all tensors, got NaN or infinity")
        return tensor.reshape(shape)


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and isinstance(value[0], (str, int))
