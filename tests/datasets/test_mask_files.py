"""Which files are masks: every picture where masks may lie is used, or named as one that is not."""

from pathlib import Path

import pytest
from refusals import refused

from kgs._support.errors import DataError
from kgs.datasets.folders import list_images
from kgs.datasets.masks import find_masks

CAMERAS = ("images/cam0/0.jpg", "images/cam1/0.jpg")
PLAIN = ("images/IMG_0.jpg", "images/IMG_1.jpg", "images/IMG_2.jpg")


def write(root: Path, *names: str) -> list[Path]:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return [root / name for name in names]


@pytest.mark.parametrize(
    ("photos", "used", "lost"),
    [
        (PLAIN, {0: "masks/IMG_0.png", 1: "images/masks/IMG_1.png"}, ()),
        (PLAIN, {0: "masks/img_0.PNG", 1: "masks/IMG_1.jpg.png", 2: "masks/IMG_2.JPG"}, ()),
        (PLAIN, {0: "masks/IMG_0.png"}, ("masks/IMG_1.gif", "masks/IMG_2.npy", "masks/sub/IMG_1.png")),
        (PLAIN, {0: "masks/IMG_0.png"}, ("masks/IMG_1_mask.png", "masks/IMG_9.png")),
        (CAMERAS, {1: "masks/cam1/0.png", 0: "images/cam0/masks/0.png"}, ("masks/cam9/0.png",)),
        (CAMERAS, {0: "masks/CAM0/0.png"}, ()),
        (CAMERAS, {0: "images/masks/cam0/0.png"}, ()),
        (CAMERAS, {0: "masks/images/cam0/0.png"}, ()),
        (CAMERAS, {0: "images/cam0/masks/0.png", 1: "images/cam1/masks/0.png"}, ()),
        (("masks/0.jpg",), {}, ()),
    ],
)
def test_masks_are_used_or_counted(
    tmp_path: Path, photos: tuple[str, ...], used: dict[int, str], lost: tuple[str, ...]
) -> None:
    paths = write(tmp_path, *photos)
    write(tmp_path, *used.values(), *lost)
    files = find_masks(paths, tmp_path)
    assert files.masks == {paths[k]: tmp_path / name for k, name in used.items()}
    assert sorted(files.lost) == sorted(tmp_path / name for name in lost)
    assert not files.unused
    assert [note.split(":")[1].split()[0] for note in files.notes(tmp_path)] == ([str(len(lost))] if lost else [])


NO_PHOTOS = ["IMG_0_mask.png", "IMG_0.jpg.png", "mask_IMG_0.JPG", "IMG_0.jpg_mask.png", "dynamic_mask_IMG_0.png"]
PHOTOS = ["IMG_0_seg.png", "IMG_9_mask.png", "IMG_0 (mask).png", "mask.png"]
FOLDERS = ["mask", "Masks", "segmentation", "Person_Masks", "images/mattes"]


@pytest.mark.parametrize(
    "name", [*(f"images/{name}" for name in (*NO_PHOTOS, *PHOTOS)), *(f"{folder}/IMG_0.png" for folder in FOLDERS)]
)
def test_what_looks_like_a_mask_is_named_and_not_used(tmp_path: Path, name: str) -> None:
    paths = write(tmp_path, *PLAIN)
    (other,) = write(tmp_path, name)
    files = find_masks(paths, tmp_path)
    in_a_folder = other.parent.name != "images"
    assert not files.masks
    assert files.unused == [other.parent if in_a_folder else other]
    (note,) = files.notes(tmp_path)
    assert name.removesuffix("/IMG_0.png") in note
    assert (other in list_images(other.parent)) == (other.name not in NO_PHOTOS)


def test_what_does_not_look_like_a_mask_is_a_photo(tmp_path: Path) -> None:
    paths = write(tmp_path, "persons_unmasked/mask_0.jpg", "persons_unmasked/a.jpg", "persons_unmasked/a.jpg.jpg")
    assert find_masks(paths, tmp_path) == ({}, [], [])
    assert len(list_images(tmp_path / "persons_unmasked")) == 3


def test_a_folder_that_is_named_is_the_only_one(tmp_path: Path) -> None:
    paths = write(tmp_path, *PLAIN)
    (mask, other, *_) = write(tmp_path, "mine/IMG_0.png", "mine/IMG_1.gif", "masks/IMG_1.png", "segmentation/IMG_2.png")
    assert find_masks(paths, tmp_path, tmp_path / "mine") == ({paths[0]: mask}, [other], [])


@pytest.mark.parametrize(
    ("masks", "folder", "wrong"),
    [
        ((), "nowhere", "nowhere"),
        (("masks/notes.txt",), "masks", "masks"),
        (("masks/IMG_0_mask.png", "masks/IMG_9.png"), None, "masks"),
        (("masks/IMG_1.npy",), None, "masks"),
        (("masks/0.png",), None, "masks/0.png"),  # of which of two photos?
        (("masks/IMG_0.png", "masks/IMG_0.jpg.png"), None, "masks/IMG_0.png"),
        (("masks/IMG_0.png", "images/masks/IMG_0.png"), None, "images/masks/IMG_0.png"),
    ],
)
def test_masks_that_are_refused(tmp_path: Path, masks: tuple[str, ...], folder: str | None, wrong: str) -> None:
    paths = write(tmp_path, *PLAIN, *CAMERAS)
    write(tmp_path, *masks)
    with refused(DataError, path=tmp_path / wrong, key=""):
        find_masks(paths, tmp_path, None if folder is None else tmp_path / folder)
