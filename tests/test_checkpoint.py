import contextlib
import hashlib
import io
import pickle

import pytest
import torch

from kgs import DataError
from kgs.fit.checkpoint import load_checkpoint, newest_checkpoint, previous, save_checkpoint


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.pt"


def test_values_come_back(path):
    state = {"step": 3, "names": ["a"], 7: (0.1, True), "nested": {"x": torch.arange(5), "none": None}}
    save_checkpoint(path, state)
    back = load_checkpoint(path)
    assert torch.equal(back["nested"].pop("x"), state["nested"].pop("x"))
    assert back == state
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.pt"]


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.int64, torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(), (0, 3), (2, 3)])
def test_tensors_come_back_bit_for_bit(path, dtype, shape):
    value = (torch.rand(shape, dtype=torch.float64) * 100).to(dtype)
    save_checkpoint(path, {"first": value, "second": value.mT if value.ndim > 1 else value})
    back = load_checkpoint(path)
    assert back["first"].dtype == dtype
    assert torch.equal(back["first"], value)
    assert torch.equal(back["second"], value.mT if value.ndim > 1 else value)


def test_every_flipped_byte_is_found(path):
    save_checkpoint(path, {"x": torch.arange(100.0)})
    content = path.read_bytes()
    for position in range(0, len(content), 97):
        damaged = bytearray(content)
        damaged[position] ^= 16
        path.write_bytes(damaged)
        with pytest.raises(DataError, match="checkpoint"):
            load_checkpoint(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 something else", b"kgs-checkpoint 1 "])
def test_other_files_are_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(DataError):
        load_checkpoint(path)


def test_missing_file_is_named(path):
    with pytest.raises(DataError, match="checkpoint.pt"):
        load_checkpoint(path)


def sealed(body):
    return b"kgs-checkpoint 2 " + hashlib.sha256(body).hexdigest().encode() + b"\n" + body


def test_code_is_neither_written_nor_read(path, tmp_path):
    class Attack:
        def __reduce__(self):
            return (open, (str(tmp_path / "touched"), "w"))

    with pytest.raises(TypeError, match="Attack"):
        save_checkpoint(path, {"x": Attack()})
    attack = io.BytesIO()
    torch.save({"x": Attack()}, attack)
    for content in (attack.getvalue(), pickle.dumps(Attack()), pickle.dumps({"x": 1})[:-3]):
        path.write_bytes(sealed(content))
        with pytest.raises(DataError, match="description"):
            load_checkpoint(path)
    assert not (tmp_path / "touched").exists()


def test_checkpoints_of_another_version_say_so(path):
    path.write_bytes(b"kgs-checkpoint 1 " + b"0" * 64 + b"\nPK")
    with pytest.raises(DataError, match="another version"):
        load_checkpoint(path)


def tensor(shape, name="float32"):
    return f'{{"dict":[["x",{{"tensor":"{name}","shape":{shape}}}]]}}'


@pytest.mark.parametrize(
    ("description", "data", "reason"),
    [
        (tensor("[3]"), bytes(11), "needs 12 bytes"),
        (tensor("[3]"), bytes(13), "1 bytes are left over"),
        (tensor("[1000000000000]"), bytes(12), "needs 4000000000000 bytes"),
        (tensor("[0,1000000000000000000000]"), b"", "shape"),
        (tensor("[-1,-1]"), bytes(4), "shape"),
        (tensor("[true]"), bytes(4), "shape"),
        (tensor("[1]", "object"), bytes(8), "value of a checkpoint"),
        (tensor("[1]"), b"\0\0\xc0\x7f", "finite"),
        ('{"dict":[["x",NaN]]}', b"", "finite"),
        ('{"dict":[["x",1e400]]}', b"", "finite"),
        ('{"dict":[["x"]]}', b"", "value of a checkpoint"),
        ('{"dict":[],"tuple":[]}', b"", "value of a checkpoint"),
        ("[1]", b"", "expected a dict"),
        ("[" * 100_000, b"", "nested too deep"),
        ("", b"", "Expecting value"),
        ("\xff", b"", "description"),
    ],
)
def test_a_right_checksum_is_not_trusted(path, description, data, reason):
    path.write_bytes(sealed(description.encode("latin-1") + b"\n" + data))
    with pytest.raises(DataError, match=reason):
        load_checkpoint(path)


def test_values_that_a_checkpoint_cannot_hold_are_not_written(path):
    for value in (torch.zeros(2, dtype=torch.complex64), {1, 2}, b"bytes"):
        with pytest.raises(TypeError, match="state: expected"):
            save_checkpoint(path, {"x": value})
    with pytest.raises(ValueError, match="JSON"):
        save_checkpoint(path, {"x": float("nan")})
    assert not path.exists()


def test_a_failed_write_leaves_the_old_file(path, monkeypatch):
    save_checkpoint(path, {"step": 1})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="space"):
        save_checkpoint(path, {"step": 2})
    assert load_checkpoint(path) == {"step": 1}
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.pt"]


def test_the_last_two_are_kept_and_the_newest_whole_one_is_found(path):
    for step in (1, 2, 3):
        save_checkpoint(path, {"step": step})
    assert load_checkpoint(path) == {"step": 3}
    assert load_checkpoint(previous(path)) == {"step": 2}
    assert newest_checkpoint(path) == ({"step": 3}, "")
    path.write_bytes(path.read_bytes()[:-1])
    state, damage = newest_checkpoint(path)
    assert state == {"step": 2}
    assert "checkpoint.pt" in damage
    path.unlink()
    assert newest_checkpoint(path)[0] == {"step": 2}
    previous(path).write_bytes(b"")
    with pytest.raises(DataError, match=r"checkpoint\.pt"):
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
