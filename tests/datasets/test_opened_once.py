"""A photo's file is opened once and its pixels are decoded once, on every path that reads photos."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import PIL.ImageFile
import pytest
from photo_folders import planes, write_photos
from tiny_scenes import write_blender, write_colmap, write_llff, write_nerfstudio

from kgs._support.errors import DataError
from kgs.app.sfm import accept, pose_photos
from kgs.datasets import image_file, load_scene

_watched: list[Counter[str]] = []


def _watch(event: str, arguments: tuple[object, ...]) -> None:
    if event == "open" and _watched and isinstance(arguments[0], str | bytes | Path):
        _watched[-1][os.fsdecode(arguments[0])] += 1


sys.addaudithook(_watch)  # cannot be removed; does nothing while nobody counts


@pytest.fixture
def opened() -> Iterator[Counter[str]]:
    """How often each file was opened, by its path, from the first line of a test that empties it."""
    _watched.append(Counter())
    yield _watched[-1]
    _watched.pop()


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The bytes of each image that was decoded."""
    sizes: list[int] = []
    real = image_file._decode

    def decode(image: PIL.ImageFile.ImageFile, data: bytes, header: image_file.Metadata) -> np.ndarray:
        sizes.append(len(data))
        return real(image, data, header)

    monkeypatch.setattr(image_file, "_decode", decode)
    return sizes


@pytest.mark.parametrize("write", [write_llff, write_colmap, write_blender, write_nerfstudio])
@pytest.mark.parametrize("downscale", [None, 2])  # 2: the training views in full size, too, for initial points
@pytest.mark.parametrize("photos", [True, False])
def test_a_scene(
    tmp_path: Path,
    write: Callable[[Path], None],
    downscale: int | None,
    photos: bool,
    opened: Counter[str],
    decoded: list[int],
) -> None:
    write(tmp_path)
    opened.clear()
    scene = load_scene(tmp_path, downscale=downscale, photos=photos)
    count = len(scene.train) + len(scene.test)
    assert (scene.train_full_size is not None) == (photos and downscale is not None)
    assert [times for name, times in opened.items() if name.endswith(".png")] == [1] * count
    assert len(decoded) == (count if photos else 0)


def test_unposed_photos(
    tmp_path: Path, opened: Counter[str], decoded: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pycolmap")
    folder = write_photos(tmp_path / "photos", planes())

    def stop(*_: object) -> None:
        raise DataError(folder, "", "a stop behind the decoding")

    monkeypatch.setattr(accept, "write_matches", stop)
    opened.clear()
    with pytest.raises(DataError, match="a stop"):
        pose_photos(folder, tmp_path / "out")
    jpegs = {Path(name).name: count for name, count in opened.items() if name.endswith(".jpg")}
    assert jpegs == {"IMG_1.jpg": 1, "IMG_2.jpg": 1, "IMG_3.jpg": 1}
    assert len(decoded) == 3
