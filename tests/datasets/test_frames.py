"""What all layouts share: names that stay in the folder, and numbers that a camera can have."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refused

from kgs._support.errors import DataError
from kgs.datasets.frames import Frame, find_file, path_inside
from kgs.datasets.image_file import ImageFile
from kgs.datasets.images import Intrinsics

LENS = Intrinsics(16, 12, 14.0, 14.0, 8.0, 6.0)
SOURCE = Path("transforms.json")


@pytest.mark.parametrize(
    "name",
    ["", "/etc/passwd", "../x.png", "a/../../x.png", "..\\x.png", "C:\\x.png", "\\\\host\\x.png", "a\0b", "x" * 5000],
)
def test_names_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    with refused(DataError, path=SOURCE):
        path_inside(SOURCE, tmp_path, name)


def test_links_that_lead_out_are_refused(tmp_path: Path) -> None:
    root, elsewhere = tmp_path / "scene", tmp_path / "elsewhere"
    root.mkdir()
    elsewhere.mkdir()
    (elsewhere / "secret.png").write_bytes(b"x")
    (root / "file.png").symlink_to(elsewhere / "secret.png")
    (root / "folder").symlink_to(elsewhere)
    for find, name in ((path_inside, "file.png"), (path_inside, "folder/secret.png"), (find_file, "FILE.png")):
        with refused(DataError, path=SOURCE, got="a link that leads out"):
            find(SOURCE, root, name)
    (root / "a.png").write_bytes(b"x")
    (root / "b.png").symlink_to(root / "a.png")  # inside
    assert path_inside(SOURCE, root, "b.png") == root / "b.png"


def test_the_scene_itself_may_be_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.png").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert path_inside(SOURCE, tmp_path / "link", "a.png").is_file()


@pytest.mark.parametrize(
    ("stored", "name"),
    [
        ("images/a.PNG", "images/a.png"),
        ("Images/A.png", "images/a.png"),
        ("images/caf\u00e9.png", "images/cafe\u0301.png"),  # macOS writes an accent by itself
        ("images/cafe\u0301.JPG", "images/caf\u00e9.jpg"),
    ],
)
def test_names_in_another_case_or_form(tmp_path: Path, stored: str, name: str) -> None:
    (tmp_path / stored).parent.mkdir()
    assert not find_file(SOURCE, tmp_path, name).is_file()
    (tmp_path / stored).write_bytes(b"x")
    assert find_file(SOURCE, tmp_path, name) == tmp_path / stored
    assert find_file(SOURCE, tmp_path, stored) == tmp_path / stored


@pytest.mark.skipif(sys.platform in ("win32", "darwin"), reason="file systems that do not tell cases apart")
def test_a_name_that_fits_two_files_is_none_of_them(tmp_path: Path) -> None:
    (tmp_path / "A.png").write_bytes(b"x")
    (tmp_path / "a.PNG").write_bytes(b"x")
    assert find_file(SOURCE, tmp_path, "a.png") == tmp_path / "a.png"
    assert find_file(SOURCE, tmp_path, "a.PNG") == tmp_path / "a.PNG"


@pytest.mark.parametrize(
    ("index", "value"),
    [((0, 0), float("nan")), ((0, 3), float("inf")), ((0, 3), 1e16)],
)
def test_poses_that_no_camera_has(index: tuple[Any, Any], value: float) -> None:
    pose = torch.eye(4, dtype=torch.float64)
    pose[index] = value
    with refused(DataError, path=SOURCE, key="photo.png"):
        Frame(SOURCE, "photo.png", ImageFile(SOURCE), LENS, pose)


@pytest.mark.parametrize(
    "numbers",
    [(28.0, 28.0, 16.0, 12.0), (14.0, 14.0, 8.0, -1.0), (14.0, 14.0, 0.0, 0.0), (1.0, 14.0, 8.0, 6.0)],
    ids=["of a photo twice as large", "above it", "of a centred image", "shares of the side"],
)
def test_lenses_that_no_camera_has(numbers: tuple[float, ...]) -> None:
    with refused(DataError, path=SOURCE, key="photo.png"):
        Frame(SOURCE, "photo.png", ImageFile(SOURCE), Intrinsics(16, 12, *numbers), torch.eye(4, dtype=torch.float64))
