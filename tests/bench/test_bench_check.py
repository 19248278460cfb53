"""`kgs check`: what it prints, and its exit code; what is refused by the benchmarks."""

import pytest
import torch

from kgs import ArgumentError, DataError, Gaussians, backends
from kgs.bench import check
from kgs.bench.scenes import check_scenes, gradients
from kgs.bench.speed import speed


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(check, "COUNTS", (20, 40))
    monkeypatch.setattr(check, "SIZE", (24, 32))


def test_it_says_versions_devices_and_which_backend_is_taken(capsys):
    assert check.check(device="cpu") == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"torch {torch.__version__}" in lines[0]
    rows = {line.split()[0]: line for line in lines if line.startswith("  ") and line.strip()}
    assert set(rows) >= set(backends.BACKENDS)
    taken = [name for name, row in rows.items() if "auto takes it" in row]
    assert taken == [backends.get_backend("auto", torch.device("cpu")).name]
    assert "not for cpu" in rows["triton"] or "not installed" in rows["triton"]
    assert max(map(len, lines)) <= 120
    assert len(lines) <= 24  # one screen


@pytest.mark.slow
def test_a_backend_that_is_wrong_or_fails_is_told_and_is_a_failure(monkeypatch, capsys):
    real = check.GaussianRenderer.forward

    def brighter(self, *arguments, **options):
        out = real(self, *arguments, **options)
        object.__setattr__(out, "image", out.image * 1.01)
        return out

    monkeypatch.setattr(check.GaussianRenderer, "forward", brighter)
    assert check.check(device="cpu") == 1
    assert "WRONG: expected at most 5e-05 (off by" in capsys.readouterr().out
    monkeypatch.setattr(check.GaussianRenderer, "forward", lambda *a, **k: 1 / 0)
    assert check.check(device="cpu") == 1
    assert "WRONG: ZeroDivisionError: division by zero" in capsys.readouterr().out


def test_gradients_that_are_not_finite_are_a_failure(monkeypatch, capsys):
    errors = torch.tensor([0.0, torch.nan, 0.0])
    monkeypatch.setattr(check, "relative_errors", lambda *_: errors)
    assert check.check(device="cpu") == 1
    assert "WRONG: expected at most 5e-05 (off by nan)" in capsys.readouterr().out


def test_what_is_not_installed_is_no_failure(monkeypatch, capsys):
    real = check.find_spec
    monkeypatch.setattr(check, "_examine", lambda *_: ("", True))  # no backend is measured
    monkeypatch.setattr(check, "find_spec", lambda name: None if name == "pycolmap" else real(name))
    assert check.check(device="cpu") == 0
    assert 'photos without cameras (pip install ".[sfm]" in a clone of kgs' in capsys.readouterr().out


def test_apples_gpus_are_answered_in_a_line(capsys):
    assert check.check(device="mps") == 0
    assert capsys.readouterr().out.startswith("kgs: Apple's GPUs have no Triton")


def test_gradients_are_taken_on_the_device_of_the_image():
    shapes = ((4, 3), (4, 4), (4, 3), (4,), (4, 3))
    gaussians = Gaussians(*(torch.empty(shape, device="meta", requires_grad=True) for shape in shapes))
    image = sum(value.sum() for value in vars(gaussians).values()).expand(1, 3, 8, 8)
    slopes = gradients(image, gaussians)
    assert {slope.device.type for slope in slopes.values()} == {"meta"}


@pytest.mark.parametrize(
    ("name", "kind", "call"),
    [
        ("device", ArgumentError, lambda _: check.check(device="nothing")),
        ("device", ArgumentError, lambda folder: speed(out=folder / "new", device="gpu9")),
        ("{}: llff/fern", DataError, lambda folder: check_scenes(folder, ["llff/fern"])),
    ],
)
def test_what_is_wrong_is_named_before_anything_is_made(name, kind, call, tmp_path):
    with pytest.raises(kind) as error:
        call(tmp_path)
    assert type(error.value) is kind
    assert str(error.value).startswith(f"{name.format(tmp_path)}: ")
    assert not list(tmp_path.iterdir())
