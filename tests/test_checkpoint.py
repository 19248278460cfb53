import pytest
import torch

from kgs import DataError
from kgs.fit.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture
def path(tmp_path):
    return tmp_path / "checkpoint.pt"


def test_values_come_back(path):
    state = {"step": 3, "names": ["a"], "nested": {"x": torch.arange(5), "none": None}}
    save_checkpoint(path, state)
    back = load_checkpoint(path)
    assert torch.equal(back["nested"].pop("x"), state["nested"].pop("x"))
    assert back == state
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.pt"]


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


def test_code_is_never_run(path, tmp_path):
    class Attack:
        def __reduce__(self):
            return (open, (str(tmp_path / "touched"), "w"))

    save_checkpoint(path, {"x": Attack()})
    with pytest.raises(Exception, match="weights_only|Unsupported"):
        load_checkpoint(path)
    assert not (tmp_path / "touched").exists()


def test_a_failed_write_leaves_the_old_file(path, monkeypatch):
    save_checkpoint(path, {"step": 1})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="space"):
        save_checkpoint(path, {"step": 2})
    assert load_checkpoint(path) == {"step": 1}
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.pt"]
