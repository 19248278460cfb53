"""Every reader and damaged files: it returns finite, valid numbers or raises a DataError, at little cost."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from cost import read_within_bounds
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from new_files import write_anew
from readers import READERS, Reader

from kgs._support.errors import DataError


@pytest.fixture(scope="module")
def valid(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Reader], Path]:
    """Writes a valid set of files for a reader, once, and reads it."""
    folders: dict[str, Path] = {}

    def folder_of(reader: Reader) -> Path:
        if reader.name not in folders:
            folders[reader.name] = tmp_path_factory.mktemp("valid")
            reader.write(folders[reader.name])
            reader.read(folders[reader.name])
        return folders[reader.name]

    return folder_of


@pytest.mark.parametrize("examples", [40, pytest.param(1500, marks=pytest.mark.slow)])
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_damaged_files_are_sound_or_refused(
    reader: Reader, examples: int, valid: Callable[[Reader], Path], capfd: pytest.CaptureFixture[str]
) -> None:
    folder, outcomes = valid(reader), set[str]()

    @seed(4)  # else what is drawn hangs on the words of this function
    @settings(max_examples=examples, database=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def check(data: st.DataObject) -> None:
        name, damage = data.draw(st.sampled_from(reader.targets))
        path = folder / name
        whole = path.read_bytes()
        damaged = data.draw(damage(whole))
        try:
            write_anew(path, damaged)
            outcomes.add(read_within_bounds(reader.read, folder))
        finally:
            write_anew(path, whole)

    check()
    capfd.readouterr()  # image libraries write warnings to the process's error stream
    assert outcomes == {"sound", "refused"}


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_files_of_noise_and_missing_files_are_refused(reader: Reader, tmp_path: Path) -> None:
    reader.write(tmp_path)
    path = tmp_path / reader.targets[0][0]
    for size in (0, 1, 100, 5000):
        path.write_bytes(random.Random(size).randbytes(size))
        with pytest.raises(DataError):
            reader.read(tmp_path)
    path.unlink()
    with pytest.raises(DataError):
        reader.read(tmp_path)
