"""Every reader under fire: what it makes of damaged files, and that the fuzzer sees what it looks for."""

from __future__ import annotations

import json
import random
import sys
from collections import Counter
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kgs.bench import hostile
from kgs.bench.hostile import READERS, measure_hostile, try_reader
from kgs.bench.mutations import mutate_bytes, mutate_json
from kgs.bench.readers import Reader, Target, check_range
from kgs.errors import DataError


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_damaged_files_are_sound_or_refused(reader: Reader) -> None:
    outcomes = try_reader(reader, range(max(10, round(40 * reader.share))))
    assert [o.what for o in outcomes if o.kind == "other"] == []
    assert [o.what for o in outcomes if o.memory is not None and o.memory >= o.allowed] == []
    assert any(o.kind == "refused" for o in outcomes)


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_many_damaged_files(reader: Reader) -> None:
    outcomes = try_reader(reader, range(1000, 1000 + round(1500 * reader.share)))
    assert [o.what for o in outcomes if o.kind == "other"] == []
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
    for seed in range(200):
        damaged, _ = mutate_json(text, random.Random(seed))
        try:
            json.loads(damaged)
        except (ValueError, RecursionError):
            kinds[False] += 1
        else:
            kinds[True] += 1
        assert damaged != text or seed  # most seeds change something
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


def test_the_program_counts_and_names_failures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = Reader("careless", _write, careless, (overwrite(200), overwrite(3)))
    monkeypatch.setattr(hostile, "READERS", (reader,))
    result = measure_hostile(tmp_path, quick=True, say=lambda line: None)
    (row,) = result["rows"]
    assert row["tried"] == row["other"] + row["sound"] == 100
    assert len(result["failures"]) == row["other"] > 10
    assert "KeyError" in result["failures"][0]
    assert json.loads((tmp_path / "hostile.json").read_text())["rows"] == result["rows"]
    assert "careless" in (tmp_path / "hostile.md").read_text()
    assert (tmp_path / "hostile.csv").is_file()
