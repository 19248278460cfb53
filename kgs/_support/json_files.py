"""Reads JSON from files of unknown origin (finite numbers, limited size, one kind of error); writes files whole."""

import json
import math
import os
import uuid
from pathlib import Path
from typing import Any, TypeGuard

from .errors import DataError

_MAX_BYTES = 64 * 2**20


def read_json(path: Path, finite: bool = True) -> dict[str, Any]:
    """Read a JSON object; a DataError if the file is missing, over 64 MiB, no object, or refused by `parse_json`."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise DataError(path, "", f"at most {_MAX_BYTES // 2**20} MiB", "more")
        value = parse_json(path.read_bytes(), finite)
    except OSError as error:
        raise DataError(path, "", "a file that can be read", advice=f"{error.strerror}") from error
    except ValueError as error:
        raise DataError(path, "", "readable JSON", advice=str(error)) from error
    if not isinstance(value, dict):
        raise DataError(path, "", "a JSON object", f"a {type(value).__name__}")
    return value


def is_number(value: Any, minimum: float = -1e300, whole: bool = False) -> TypeGuard[float]:
    """Whether a JSON value is a number from `minimum` to a fixed limit, and no bool; JSON itself has no limit."""
    return type(value) in ((int,) if whole else (int, float)) and minimum <= value < (2**48 if whole else 1e300)


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all; a ValueError if a number is not finite."""
    write_whole(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; a link stays one, and after an OSError what was there is untouched."""
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".kgs-{uuid.uuid4().hex}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, target)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from error
    finally:
        temporary.unlink(missing_ok=True)


def parse_json(text: bytes, finite: bool = True) -> Any:
    """The value of UTF-8 text, which may begin with a byte order mark.

    `finite=False` reads NaN, Infinity and numbers beyond float64, as many programs write them, for a caller that can
    say where they are.

    Raises:
        ValueError: it is not JSON (NaN and Infinity are not), nested too deep, or holds a number beyond float64.
    """
    number = _finite if finite else float
    try:
        return json.loads(text.decode("utf-8-sig"), parse_constant=number, parse_float=number)
    except RecursionError as error:
        raise ValueError("nested too deep") from error


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:60]} is not a finite number")
    return number
