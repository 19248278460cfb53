"""That the kernels have passed their check is kept between processes, for one card and one version of all."""

import warnings
from types import SimpleNamespace

import pytest
import torch
import triton

from kgs.backends.gpu import trust

CARD = torch.device("cuda", 0)


@pytest.fixture(autouse=True)
def card(monkeypatch, tmp_path):
    """The properties of a card that is not there, and Triton's folder."""
    found = SimpleNamespace(name="Card 9000")
    module = SimpleNamespace(get_device_properties=lambda device: found)
    monkeypatch.setattr(torch, "get_device_module", lambda device: module)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path / "cache"))
    trust.passes_check.cache_clear()
    yield found
    trust.passes_check.cache_clear()


def test_a_passed_check_is_known_from_then_on(tmp_path):
    assert not trust.is_kept(CARD)
    trust.keep(CARD)
    assert trust.is_kept(CARD)
    assert trust.is_kept(torch.device("cuda", 1))  # another card of that name
    assert len(list(tmp_path.rglob("kgs_self_check.json"))) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda patch, card: setattr(card, "name", "Card 9001"),
        lambda patch, card: setattr(card, "gcnArchName", "gfx942"),
        lambda patch, card: setattr(card, "driver_version", "1.2"),
        lambda patch, card: patch.setattr("platform.release", lambda: "7.0"),
        lambda patch, card: patch.setenv("TRITON_PTXAS_PATH", "/opt/ptxas"),
        lambda patch, card: patch.setenv("DISABLE_PTXAS_OPT", "1"),
        lambda patch, card: patch.setattr(torch, "__version__", "99.0"),
        lambda patch, card: patch.setattr(triton, "__version__", "99.0"),
        lambda patch, card: patch.setattr(trust, "__version__", "99.0"),
        lambda patch, card: patch.setattr(trust, "_source", lambda: "other"),
    ],
)
def test_anything_else_is_checked_anew(change, card, monkeypatch):
    trust.keep(CARD)
    change(monkeypatch, card)
    assert not trust.is_kept(CARD)
    trust.keep(CARD)
    assert trust.is_kept(CARD)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe", b'{"card": "Card 9000"}'])
def test_a_damaged_file_is_checked_anew(content, tmp_path):
    trust.keep(CARD)
    (file,) = tmp_path.rglob("kgs_self_check.json")
    file.write_bytes(content)
    assert not trust.is_kept(CARD)
    trust.keep(CARD)
    assert trust.is_kept(CARD)


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "cache").write_text("a file")
    trust.keep(CARD)
    assert not trust.is_kept(CARD)


def test_the_next_process_does_not_check_again(monkeypatch):
    checks = []
    monkeypatch.setattr("kgs.backends.self_check.largest_error", lambda *arguments: checks.append(1) or 1e-7)
    assert trust.passes_check(CARD)
    assert len(checks) == 2
    trust.passes_check.cache_clear()  # as in another process
    assert trust.passes_check(CARD)
    assert len(checks) == 2


def test_a_check_that_failed_is_done_again_in_the_next_process(monkeypatch):
    found = [1.0, 1.0]
    monkeypatch.setattr("kgs.backends.self_check.largest_error", lambda *arguments: found[-1])
    with pytest.warns(UserWarning, match="differ from torch by 1"):
        assert not trust.passes_check(CARD)
    with warnings.catch_warnings():  # this process keeps to it
        warnings.simplefilter("error")
        assert not trust.passes_check(CARD)
    trust.passes_check.cache_clear()
    found.append(1e-7)
    assert trust.passes_check(CARD)
