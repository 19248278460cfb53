"""Seeded damage to valid files: what broken disks, cut downloads, bugs of other programs and attackers do to them.

Each function takes the bytes of a file and a random generator and returns the damaged bytes and what was done, in
words. The same generator state gives the same damage.
"""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Callable
from typing import Any

__all__ = ["GEOMETRIC_KEYS", "Mutator", "mutate_bytes", "mutate_json", "mutate_words"]

Mutator = Callable[[bytes, random.Random], tuple[bytes, str]]

_INTEGERS = (0, 1, 2, 3, 7, 127, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-30, 1e30, 3e38, -1e300, float("inf"), float("-inf"), float("nan"))
_DIGITS = "0 -0 -1 1 2 1e400 -1e400 1e300 1e-320 5e-324 1e39 3.5 1e9 1_0 0x10 4294967296 18446744073709551616"
_NUMBERS = (*_DIGITS.split(), "9" * 400)
_NUMBER_WORDS = (*_NUMBERS, "9" * 5000, "nan", "inf")
_NAMES = ("", ".", "..", "../../etc/passwd", "/etc/passwd", "C:\\x", "images", "x" * 300, "é", "\x7f", "a/" * 3000)
_TOKENS = (
    *_NUMBERS,
    *("NaN", "Infinity", "-Infinity", "null", "true", "[]", "{}", "[[]]", "[1, 2]", '{"a": 1}'),
    *("[" * 3000, "[" * 3000 + "]" * 3000, '"\\ud800"', '"\\u0000"'),
    *map(json.dumps, _NAMES),
)
# Keys of other programs' files: each one changes the cameras or the pictures, and must be used or refused.
GEOMETRIC_KEYS: dict[str, Any] = {
    **{"is_fisheye": True, "camera_model": "EQUIRECTANGULAR", "camera_angle_y": 0.3, "camera_angle_x": 1.1},
    **{"fl_x": 20.0, "fl_y": 30.0, "cx": 5.0, "cy": 9.0, "k1": 0.1, "k2": 0.05, "k3": 0.03, "k4": 0.1, "p1": 0.01},
    **{"p2": 0.01, "ftheta_p0": 0.1, "mask_path": "mask.png", "w": 17, "h": 13, "lens": "fisheye"},
    **{"train_filenames": ["images/0.png"], "test_filenames": ["images/1.png"], "ply_file_path": "points.ply"},
}
_BOM = b"\xef\xbb\xbf"
_MARK = "@damaged here@"


def mutate_bytes(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """One to three of: bits flipped, extreme numbers written over, bytes cut, removed, repeated, ..."""
    words = []
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        data, what = rng.choice(_BYTE_OPERATIONS)(data, rng)
        words.append(what)
    return data, ", ".join(words)


def mutate_words(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A change to the words or lines of a text; one time in three to its bytes."""
    if rng.random() < 0.33:
        return mutate_bytes(data, rng)
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    words = lines[at].split(b" ")
    word = rng.randrange(len(words))
    token = rng.choice((*_NUMBER_WORDS, *_NAMES)).encode()
    match rng.randrange(7):
        case 0 | 1 | 2:
            words[word], what = token, f"word {word} of line {at} is {_short(token)}"
        case 3:
            what = f"word {word} of line {at} is gone"
            del words[word]
        case 4:
            what = f"line {at} twice"
            lines.insert(at, lines[at])
        case 5:
            what = "a byte order mark"
            lines[0] = _BOM + lines[0]
            words = lines[at].split(b" ")
        case _:
            what = f"line {at} is gone"
            words = []
            del lines[at]
            lines.insert(at, b"")
    lines[at] = b" ".join(words)
    return b"\n".join(lines), what


def mutate_json(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A value replaced by a hostile one, a key or an element removed, doubled or added; at times damaged bytes."""
    if rng.random() < 0.15:
        return mutate_bytes(data, rng)
    if rng.random() < 0.02:
        return _BOM + data, "a byte order mark"
    tree = json.loads(data)
    holder, key = rng.choice(list(_places(tree)))
    token = rng.choice(_TOKENS)
    match rng.randrange(8):
        case 0 | 1 | 2 | 3:
            holder[key], what = _MARK, f"{key} is {_short(token.encode())}"
        case 4:
            what = f"{key} is gone"
            del holder[key]
        case 5 if isinstance(holder, dict):
            what = f"{key} again, as {_short(token.encode())}"
            holder[_MARK] = 0
            token = f"{json.dumps(key)}: {token}"
        case 5:
            what = f"element {key} twice"
            holder.insert(key, holder[key])
        case 6 if isinstance(holder, dict):
            added = rng.choice(list(GEOMETRIC_KEYS))
            what = f"{added} beside {key}"
            holder[added] = GEOMETRIC_KEYS[added]
        case _:
            value, factor = holder[key], rng.choice((-1, 0, 0.5, 1.01, 2, 1e20, 1e-20))
            holder[key] = value * factor if isinstance(value, (int, float)) else [value]
            what = f"{key} times {factor}, or in a list"
    text = json.dumps(tree)
    return text.replace(f'"{_MARK}": 0', token).replace(f'"{_MARK}"', token).encode("utf-8", "surrogatepass"), what


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """Every container with every key or index in it."""
    found, waiting = [], [tree]
    while waiting:
        holder = waiting.pop()
        for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
            found.append((holder, key))
            if isinstance(holder[key], (dict, list)):
                waiting.append(holder[key])
    return found


def _short(token: bytes) -> str:
    return repr(token if len(token) < 40 else token[:20] + b"..." + str(len(token)).encode())


def _flip(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    changed, count = bytearray(data or b"\0"), rng.choice((1, 1, 2, 8))
    places = [rng.randrange(len(changed)) for _ in range(count)]
    for at in places:
        changed[at] ^= 1 << rng.randrange(8)
    return bytes(changed), f"a bit flipped at each of {places}"


def _overwrite(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    order = rng.choice("<>")
    if rng.random() < 0.6:
        number: float = rng.choice((*_INTEGERS, len(data), rng.randrange(2**16)))
        width = rng.choice((1, 2, 4, 8))
        new = struct.pack(order + "Q", number)
        new = new[:width] if order == "<" else new[-width:]
    else:
        number, form = rng.choice(_FLOATS), rng.choice("fd")
        new = struct.pack(order + form, number if form == "d" or abs(number) < 1e39 else float("inf"))
    at = rng.randrange(max(1, len(data)))
    if rng.random() < 0.5:  # most formats align their numbers
        at -= at % len(new)
    return data[:at] + new + data[at + len(new) :], f"{number} in {len(new)} bytes ({order}) at {at}"


def _cut(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    at = rng.randrange(len(data) + 1)
    return data[:at], f"cut at {at}"


def _remove(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    begin, end = _slice(data, rng)
    return data[:begin] + data[end:], f"{begin}:{end} removed"


def _repeat(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    begin, end = _slice(data, rng)
    return data[:end] + data[begin:], f"{begin}:{end} repeated"


def _insert(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    at, size = rng.randrange(len(data) + 1), rng.choice((1, 2, 4, 8, 100))
    new = rng.choice((bytes(size), b"\xff" * size, rng.randbytes(size)))
    return data[:at] + new + data[at:], f"{size} bytes inserted at {at}"


def _append(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """As phones put a film behind a photo."""
    new = rng.choice((b"\0", data, rng.randbytes(100), b"\xff\xd9", bytes(5000)))
    return data + new, f"{len(new)} bytes behind the end"


def _swap(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    begin, end = _slice(data, rng)
    middle = rng.randint(begin, end)
    return data[:begin] + data[middle:end] + data[begin:middle] + data[end:], f"{begin}:{middle}:{end} swapped"


def _slice(data: bytes, rng: random.Random) -> tuple[int, int]:
    begin = rng.randrange(len(data) + 1)
    return begin, min(len(data), begin + rng.choice((1, 2, 4, 8, 17, 64, 1000)))


_BYTE_OPERATIONS = (_flip, _flip, _overwrite, _overwrite, _overwrite, _cut, _remove, _repeat, _insert, _swap, _append)
