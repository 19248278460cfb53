"""JSON from files of unknown origin."""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from kgs._support.errors import DataError
from kgs._support.json_files import parse_json, read_json

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)


@given(VALUES)
def test_what_json_can_say_is_read(value: object) -> None:
    assert parse_json(json.dumps(value).encode()) == value


@given(st.binary(max_size=60) | st.text(alphabet='{}[]",:0123456789eE+-.NaInfty \\', max_size=40).map(str.encode))
@settings(max_examples=300)
def test_anything_else_is_a_value_error(text: bytes) -> None:
    with contextlib.suppress(ValueError):
        json.dumps(parse_json(text), allow_nan=False)


@pytest.mark.parametrize(
    "text",
    [
        b"[1, 2]",
        b'{"a": NaN}',
        b'{"a": 1e400}',
        b'{"a": ' + b"[" * 100_000,
        b'{"a": 1',
        b"\xff\xfe",
        b'{"a": ' + b"9" * 5000 + b"}",  # Python's own limit of the digits
        b'{"a": 1}' + b" " * 2**26,  # over 64 MiB
    ],
    ids=["a list", "NaN", "beyond float64", "nested too deep", "cut short", "not UTF-8", "digits", "too large"],
)
def test_files_that_are_refused(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(text)
    for wrong in (path, tmp_path, tmp_path / "missing"):
        with refused(DataError, path=wrong, key=""):
            read_json(wrong)


def test_numbers_that_are_not_finite_are_read_on_request(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'{"a": [-Infinity, 1e400, 1.5, 2], "b": NaN}')
    value = read_json(tmp_path / "a.json", finite=False)
    assert value["a"] == [-math.inf, math.inf, 1.5, 2]
    assert math.isnan(value["b"])
    with pytest.raises(ValueError, match="Expecting value"):
        parse_json(b"infinity", finite=False)


def test_a_byte_order_mark_and_repeated_keys_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1, "a": 2}')
    assert read_json(tmp_path / "a.json") == {"a": 2}
