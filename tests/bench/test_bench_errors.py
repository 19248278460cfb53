"""What is refused by the benchmarks: the type of the error, and the name that it begins with."""

import pytest

from kgs import DataError
from kgs.bench.check import check
from kgs.bench.scenes import check_scenes
from kgs.bench.speed import speed

CASES = [
    ("device", ValueError, lambda _: check(device="nothing")),
    ("device", ValueError, lambda folder: speed(out=folder / "new", device="gpu9")),
    ("FOLDER: llff/fern", DataError, lambda folder: check_scenes(folder, ["llff/fern"])),
]


@pytest.mark.parametrize(("name", "kind", "call"), CASES)
def test_what_is_wrong_is_named_before_anything_is_made(name, kind, call, tmp_path):
    with pytest.raises(kind) as error:
        call(tmp_path)
    assert type(error.value) is kind
    assert str(error.value).startswith(f"{name.replace('FOLDER', str(tmp_path))}: ")
    assert not list(tmp_path.iterdir())
