"""Hypothesis strategies for damage to valid files: broken disks, cut downloads, bugs of other programs, attackers.

Each strategy takes the bytes of a valid file and yields damaged bytes.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Callable
from typing import Any

import safetensors.torch
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from tiny_scenes import png_chunk

from kgs.fit.checkpoint import _digest_all

Damage = Callable[[bytes], SearchStrategy[bytes]]

_INTEGERS = (0, 1, 2, 3, 7, 127, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-320, 1e-30, 1e30, 3e38, -1e300, float("inf"), float("-inf"), float("nan"))
_DIGITS = "0 -0 -1 1 2 1e400 -1e400 1e300 1e-320 5e-324 1e39 3.5 1e9 1_0 0x10 4294967296 18446744073709551616"
_NUMBERS = (*_DIGITS.split(), "9" * 400)
_NAMES = ("", ".", "..", "../../etc/passwd", "/etc/passwd", "C:\\x", "images", "x" * 300, "é", "\x7f", "a/" * 3000)
_WORDS = (*_NUMBERS, "9" * 5000, "nan", "inf", *_NAMES)
_JSON = (
    *_NUMBERS,
    *("NaN", "Infinity", "-Infinity", "null", "true", "[]", "{}", "[[]]", "[1, 2]", '{"a": 1}'),
    *("[" * 3000, "[" * 3000 + "]" * 3000, '"\\ud800"', '"\\u0000"'),
    *map(json.dumps, _NAMES),
)
# Keys of other programs' files: each one changes the cameras or the images, and must be used or refused.
GEOMETRIC_KEYS: dict[str, Any] = {
    **{"is_fisheye": True, "camera_model": "EQUIRECTANGULAR", "camera_angle_y": 0.3, "camera_angle_x": 1.1},
    **{"fl_x": 20.0, "fl_y": 30.0, "cx": 5.0, "cy": 9.0, "k1": 0.1, "k2": 0.05, "k3": 0.03, "k4": 0.1, "p1": 0.01},
    **{"p2": 0.01, "ftheta_p0": 0.1, "mask_path": "mask.png", "w": 17, "h": 13, "lens": "fisheye"},
    **{"train_filenames": ["images/0.png"], "test_filenames": ["images/1.png"], "ply_file_path": "points.ply"},
}
_BOM = b"\xef\xbb\xbf"
_PLACEHOLDER = "@damaged here@"


def _encoded(order: str) -> SearchStrategy[bytes]:
    """An extreme number in one to eight bytes."""
    wide = st.sampled_from(_INTEGERS).map(lambda number: number.to_bytes(8, "little" if order == "<" else "big"))
    integers = st.tuples(wide, st.sampled_from((1, 2, 4, 8))).map(
        lambda drawn: drawn[0][: drawn[1]] if order == "<" else drawn[0][-drawn[1] :]
    )
    doubles = st.sampled_from(_FLOATS).map(lambda number: struct.pack(order + "d", number))
    singles = st.sampled_from([x for x in _FLOATS if not 1e39 < abs(x) < float("inf")]).map(
        lambda number: struct.pack(order + "f", number)
    )
    return integers | doubles | singles


@st.composite
def damaged_bytes(draw: DrawFn, data: bytes) -> bytes:
    """One to three of: bits flipped, extreme numbers written over, bytes cut, removed, repeated, inserted, appended."""
    for _ in range(draw(st.integers(1, 3))):
        begin = draw(st.integers(0, len(data)))
        end = min(len(data), begin + draw(st.sampled_from((1, 2, 4, 8, 17, 64, 1000))))
        match draw(st.sampled_from(("flip", "write", "write", "cut", "remove", "repeat", "insert", "append"))):
            case "flip" if begin < len(data):
                flipped = data[begin] ^ (1 << draw(st.integers(0, 7)))
                data = data[:begin] + bytes([flipped]) + data[begin + 1 :]
            case "write":
                new = draw(_encoded(draw(st.sampled_from("<>"))))
                if draw(st.booleans()):  # most formats align their numbers
                    begin -= begin % len(new)
                data = data[:begin] + new + data[begin + len(new) :]
            case "remove":
                data = data[:begin] + data[end:]
            case "repeat":
                data = data[:end] + data[begin:]
            case "insert":
                data = data[:begin] + draw(st.binary(min_size=1, max_size=100)) + data[begin:]
            case "append":  # as phones put a film behind a photo
                data += draw(st.sampled_from((b"\0", data, b"\xff\xd9", bytes(5000))) | st.binary(max_size=100))
            case _:
                data = data[:begin]
    return data


@st.composite
def damaged_text(draw: DrawFn, data: bytes) -> bytes:
    """Words or lines of a text replaced, removed or doubled; or its bytes damaged."""
    lines = data.split(b"\n")
    at = draw(st.integers(0, len(lines) - 1))
    words = lines[at].split(b" ")
    word = draw(st.integers(0, len(words) - 1))
    match draw(st.sampled_from(("bytes", "replace", "replace", "remove", "double", "mark", "remove line"))):
        case "bytes":
            return draw(damaged_bytes(data))
        case "replace":
            words[word] = draw(st.sampled_from(_WORDS)).encode()
            lines[at] = b" ".join(words)
        case "remove":
            lines[at] = b" ".join(words[:word] + words[word + 1 :])
        case "double":
            lines.insert(at, lines[at])
        case "mark":
            lines[0] = _BOM + lines[0]
        case _:
            lines[at] = b""
    return b"\n".join(lines)


@st.composite
def damaged_json(draw: DrawFn, data: bytes) -> bytes:
    """A value replaced, a key or an element removed, doubled or added; or the bytes of the text damaged."""
    tree = json.loads(data)
    holder, key = draw(st.sampled_from(list(_slots(tree))))
    token = draw(st.sampled_from(_JSON))
    kinds = ("bytes", "mark", "replace", "replace", "replace", "remove", "double", "add", "scale")
    match draw(st.sampled_from(kinds)):
        case "bytes":
            return draw(damaged_bytes(data))
        case "mark":
            return _BOM + data
        case "replace":
            holder[key] = _PLACEHOLDER
        case "remove":
            del holder[key]
        case "double" if isinstance(holder, list):
            holder.insert(key, holder[key])
        case "double":
            holder[_PLACEHOLDER], token = 0, f"{json.dumps(key)}: {token}"
        case "add" if isinstance(holder, dict):
            added = draw(st.sampled_from(list(GEOMETRIC_KEYS)))
            holder[added] = GEOMETRIC_KEYS[added]
        case _:
            value, factor = holder[key], draw(st.sampled_from((-1, 0, 0.5, 1.01, 2, 1e20, 1e-20)))
            holder[key] = value * factor if isinstance(value, int | float) else [value]
    text = json.dumps(tree).replace(f'"{_PLACEHOLDER}": 0', token).replace(f'"{_PLACEHOLDER}"', token)
    return text.encode("utf-8", "surrogatepass")


def _slots(tree: Any) -> list[tuple[Any, Any]]:
    """Every container with every key or index in it."""
    found, waiting = [], [tree]
    while waiting:
        holder = waiting.pop()
        for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
            found.append((holder, key))
            if isinstance(holder[key], dict | list):
                waiting.append(holder[key])
    return found


# -- damage under a checksum that is made right again --------------------------------------------------------------


@st.composite
def damaged_png_chunk(draw: DrawFn, data: bytes) -> bytes:
    """One chunk of a PNG image damaged."""
    chunks, at = [], 8
    while at < len(data):
        size = struct.unpack_from(">I", data, at)[0]
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += size + 12
    chosen = draw(st.integers(0, len(chunks) - 1))
    chunks[chosen] = chunks[chosen][0], draw(damaged_bytes(chunks[chosen][1]))
    return data[:8] + b"".join(png_chunk(kind, body) for kind, body in chunks)


@st.composite
def damaged_zip_member(draw: DrawFn, data: bytes) -> bytes:
    """One file of an archive damaged."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    chosen = draw(st.sampled_from(list(members)))
    members[chosen] = draw(damaged_bytes(members[chosen]))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return packed.getvalue()


@st.composite
def damaged_checkpoint(draw: DrawFn, data: bytes) -> bytes:
    """The JSON of a checkpoint damaged, or its tensors."""
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    metadata = header["__metadata__"]
    if draw(st.booleans()):
        metadata["state"] = draw(damaged_json(metadata["state"].encode())).decode(errors="replace")
    else:
        body = draw(damaged_bytes(body))[: len(body)].ljust(len(body), b"\0")  # of the size in the header
    head = json.dumps(header).encode()
    tensors = safetensors.torch.load(len(head).to_bytes(8, "little") + head + body)
    metadata["sha256"] = _digest_all(metadata["state"], tensors)
    head = json.dumps(header).encode()
    return len(head).to_bytes(8, "little") + head + body
