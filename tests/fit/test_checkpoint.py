"""Checkpoints: tensors and values come back bit for bit, and no damage passes."""

import contextlib
import json
import os
import stat

import pytest
import safetensors.torch
import torch
from new_files import write_anew
from refusals import refused

from kgs import DataError
from kgs.fit import checkpoint
from kgs.fit.checkpoint import _digest_all, load_checkpoint, newest_checkpoint, previous, save_checkpoint


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.safetensors"


def test_values_come_back(path):
    state = {"step": 3, "names": ["a", 0.1, True, None, "é"], "nested": {"x": torch.arange(5), "none": None, "no": {}}}
    save_checkpoint(path, state)
    back = load_checkpoint(path)
    assert torch.equal(back["nested"].pop("x"), state["nested"].pop("x"))
    assert back == state
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.int64, torch.float32, torch.float64, torch.bool])
@pytest.mark.parametrize("shape", [(), (0, 3), (2, 3)])
def test_tensors_come_back_bit_for_bit(path, dtype, shape):
    value = (torch.rand(shape, dtype=torch.float64) * 100).to(dtype)
    save_checkpoint(path, {"first": value, "second": value.mT if value.ndim > 1 else value})
    back = load_checkpoint(path)
    assert back["first"].dtype == dtype
    assert torch.equal(back["first"], value)
    assert torch.equal(back["second"], value.mT if value.ndim > 1 else value)
    back["first"].fill_(1)  # memory of its own


def test_others_can_open_it(path):
    save_checkpoint(path, {"step": 3, "model": {"means": torch.ones(2, 3)}})
    with safetensors.safe_open(path, "pt") as file:
        assert list(file.keys()) == ["model/means"]
        assert json.loads(file.metadata()["state"]) == {"step": 3, "model": {}}


def test_every_flipped_byte_and_every_cut_is_found(path):
    save_checkpoint(path, {"step": 3, "model": {"x": torch.arange(4.0), "y": torch.arange(3)}})
    content = path.read_bytes()
    for position in range(len(content)):
        flipped = bytearray(content)
        flipped[position] ^= 1 << position % 8
        for damaged in (flipped, content[:position]):
            write_anew(path, damaged)
            with refused(DataError, path=path):
                load_checkpoint(path)
    path.write_bytes(content + b"1")
    with refused(DataError, path=path):
        load_checkpoint(path)


def test_safetensors_of_other_programs_are_refused(path):
    safetensors.torch.save_file({"x": torch.ones(3)}, path, {"format": "pt"})
    with refused(DataError, path=path, key="format", got="'pt'"):
        load_checkpoint(path)


def sealed(text, tensors):
    """A file with the right checksum."""
    metadata = {"format": checkpoint._FORMAT, "state": text, "sha256": _digest_all(text, tensors)}
    return safetensors.torch.save(tensors, metadata)


@pytest.mark.parametrize(
    ("text", "tensors", "key"),
    [
        ("{}", {"x": torch.tensor([torch.nan])}, "x"),
        ("{}", {"model/x": torch.ones(1)}, "model"),
        ('{"model":[]}', {"model/x": torch.ones(1)}, ""),
        ('{"model":3}', {"model/x": torch.ones(1)}, ""),
        ("[]", {}, "state"),
        *[(text, {}, "") for text in ('{"x":NaN}', '{"x":1e400}', "[" * 100_000, "")],
    ],
)
def test_a_right_checksum_is_not_trusted(path, text, tensors, key):
    path.write_bytes(sealed(text, tensors))
    with refused(DataError, path=path, key=key):
        load_checkpoint(path)


class Attack:
    def __reduce__(self):
        return (print, ("run",))


def test_code_and_values_that_a_checkpoint_cannot_hold_are_not_written(path):
    for value in (Attack(), {1, 2}, b"bytes", {3: "number as key"}, {"a/b": 1}):
        with pytest.raises(TypeError):
            save_checkpoint(path, {"x": value})
    with pytest.raises(ValueError, match="JSON"):
        save_checkpoint(path, {"x": float("nan")})
    assert not path.exists()


def test_a_file_system_that_cannot_sync_folders_is_no_fault(path, monkeypatch):
    plain = os.fsync

    def fsync(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(22, "Invalid argument")
        plain(descriptor)

    monkeypatch.setattr("os.fsync", fsync)
    save_checkpoint(path, {"step": 1})
    assert load_checkpoint(path) == {"step": 1}


def test_the_last_two_are_kept_and_the_newest_whole_one_is_found(path):
    for step in (1, 2, 3):
        save_checkpoint(path, {"step": step})
    assert load_checkpoint(path) == {"step": 3}
    assert load_checkpoint(previous(path)) == {"step": 2}
    assert newest_checkpoint(path) == ({"step": 3}, "")
    path.write_bytes(path.read_bytes()[:-1])
    state, damage = newest_checkpoint(path)
    assert state == {"step": 2}
    assert "checkpoint.safetensors" in damage
    path.unlink()
    assert newest_checkpoint(path)[0] == {"step": 2}
    previous(path).write_bytes(b"")
    with refused(DataError, path=path):
        newest_checkpoint(path)


@pytest.mark.parametrize("call", ["os.replace", "os.fsync"])
@pytest.mark.parametrize("after", [0, 1, 2])
def test_wherever_a_write_fails_a_whole_checkpoint_is_left(path, monkeypatch, call, after):
    save_checkpoint(path, {"step": 1})
    save_checkpoint(path, {"step": 2})
    module, name = call.split(".")
    plain, calls = getattr(__import__(module), name), []

    def failing(*arguments):
        calls.append(arguments)
        if len(calls) > after:
            raise OSError(5, "Input/output error")
        return plain(*arguments)

    monkeypatch.setattr(call, failing)
    with contextlib.suppress(OSError):
        save_checkpoint(path, {"step": 3})
    monkeypatch.undo()
    assert newest_checkpoint(path)[0]["step"] in (2, 3)
    assert not list(path.parent.glob("*.partial"))
