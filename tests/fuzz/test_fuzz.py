"""Every reader under fire: what it makes of damaged files, and that the fuzzer sees what it looks for."""

from __future__ import annotations

import json
import random
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import mutate_bytes, mutate_json
from readers import Reader, Target, check_range
from targets import READERS
from trials import is_cheap, table_row, try_reader

from kgs.errors import DataError


@pytest.mark.parametrize("trials", [40, pytest.param(1500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_damaged_files_are_sound_or_refused(
    reader: Reader, trials: int, record_property: Callable[[str, object], None]
) -> None:
    outcomes = try_reader(reader, range(round(trials * reader.share)))
    record_property("hostile", table_row(reader, outcomes))
    assert [o.what for o in outcomes if o.kind == "other"] == []
    assert [o.what for o in outcomes if not is_cheap(o)] == []
    assert {o.kind for o in outcomes} == {"sound", "refused"}


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_files_of_noise_are_refused(reader: Reader, tmp_path: Path) -> None:
    reader.write(tmp_path)
    path = tmp_path / reader.targets[0].path
    for size in (0, 1, 100, 5000):
        path.write_bytes(random.Random(size).randbytes(size))
        with pytest.raises(DataError):
            reader.read(tmp_path)
    path.unlink()
    with pytest.raises(DataError):
        reader.read(tmp_path)


@given(data=st.binary(max_size=200), seed=st.integers(0, 2**32))
@settings(max_examples=200)
def test_damage_is_the_same_for_the_same_seed(data: bytes, seed: int) -> None:
    assert mutate_bytes(data, random.Random(seed)) == mutate_bytes(data, random.Random(seed))


def test_damage_to_json_mostly_keeps_it_json() -> None:
    text = json.dumps({"a": [1, 2.5, {"b": "c"}], "d": None}).encode()
    kinds: Counter[bool] = Counter()
    unchanged = 0
    for seed in range(200):
        damaged, _ = mutate_json(text, random.Random(seed))
        try:
            json.loads(damaged)
        except (ValueError, RecursionError):
            kinds[False] += 1
        else:
            kinds[True] += 1
        unchanged += damaged == text
    assert unchanged < 10
    assert kinds[True] > 60
    assert kinds[False] > 10


def careless(folder: Path) -> None:
    """A reader that believes what it reads."""
    data = (folder / "a.bin").read_bytes()
    if data[0] > 100:
        raise KeyError("a bare error")
    if data[0] > 50:
        check_range("value", torch.tensor(float("nan")))
    if data[0] > 25:
        raise DataError(folder, "", "refused")
    if data[0] == 25:
        bytearray(2**28)


def overwrite(value: int) -> Target:
    return Target("a.bin", lambda data, rng: (bytes([value]) + data[1:], f"{value}"))


@pytest.mark.parametrize(("value", "kind"), [(200, "other"), (60, "other"), (30, "refused"), (3, "sound")])
def test_it_tells_errors_from_refusals(value: int, kind: str) -> None:
    reader = Reader("careless", lambda folder: _write(folder), careless, (overwrite(value),))
    (outcome,) = try_reader(reader, range(1))
    assert outcome.kind == kind


@pytest.mark.skipif(sys.platform != "linux", reason="resident memory is measured on Linux")
def test_it_sees_what_a_reader_allocates() -> None:
    reader = Reader("careless", lambda folder: _write(folder), careless, (overwrite(25),))
    (outcome,) = try_reader(reader, range(1))
    assert outcome.memory is not None
    assert outcome.memory > 2**27 > outcome.allowed


def _write(folder: Path) -> None:
    (folder / "a.bin").write_bytes(bytes(4))


def test_a_row_counts_what_was_tried(tmp_path: Path) -> None:
    reader = Reader("careless", _write, careless, (overwrite(200), overwrite(3)))
    outcomes = try_reader(reader, range(100))
    row = table_row(reader, outcomes)
    assert row["trials"] == row["other"] + row["sound"] == 100
    assert row["other"] > 10
    assert "KeyError" in next(outcome.what for outcome in outcomes if outcome.kind == "other")
