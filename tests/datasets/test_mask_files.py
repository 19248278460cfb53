"""Which files are masks: every picture where masks may lie is used, or named as one that is not."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from kgs.datasets.mask_files import find_mask_files

CAMERAS = ("images/cam0/0.jpg", "images/cam1/0.jpg")
PLAIN = ("images/IMG_0.jpg", "images/IMG_1.jpg", "images/IMG_2.jpg")
GREY = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()


def write(root: Path, *names: str) -> list[Path]:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(GREY)
    return [root / name for name in names]


@pytest.mark.parametrize(
    ("photos", "used", "unused"),
    [
        (PLAIN, {0: "masks/IMG_0.png", 1: "mask/IMG_1.png"}, ()),
        (PLAIN, {0: "masks/IMG_0.png", 1: "images/masks/IMG_1.png"}, ("images/masks/IMG_0.png",)),
        (PLAIN, {0: "masks/IMG_0.png"}, ("mask/IMG_0.png", "mask/IMG_9.png")),
        (PLAIN, {0: "masks/IMG_0.png"}, ("masks/IMG_1.gif", "masks/IMG_2.npy", "masks/sub/IMG_1.png")),
        (PLAIN, {}, ("masks/IMG_1.gif", "masks/sub/IMG_0.png")),
        (PLAIN, {0: "images/IMG_0_mask.png"}, ("segmentation",)),
        (PLAIN, {0: "masks/IMG_0.png"}, ("images/IMG_0_mask.png",)),
        (PLAIN, {0: "images/IMG_0_mask.png"}, ("images/dynamic_mask_IMG_0.png", "images/dynamic_mask_IMG_2.jpg")),
        (CAMERAS, {1: "masks/cam1/0.png", 0: "images/cam0/masks/0.png"}, ()),
        (CAMERAS, {0: "masks/CAM0/0.png"}, ()),
        (CAMERAS, {0: "images/masks/cam0/0.png"}, ()),
        (CAMERAS, {0: "masks/images/cam0/0.png"}, ()),
        (CAMERAS, {0: "images/cam0/masks/0.png", 1: "images/cam1/masks/0.png"}, ()),
        (CAMERAS, {0: "images/cam0/masks/0.png", 1: "masks/cam1/0.png"}, ("masks/cam9/0.png",)),
        (("persons_unmasked/0.jpg",), {}, ()),
    ],
)
def test_masks_are_used_or_named(
    tmp_path: Path, photos: tuple[str, ...], used: dict[int, str], unused: tuple[str, ...]
) -> None:
    paths = write(tmp_path, *photos)
    write(tmp_path, *used.values(), *(name if "." in name else f"{name}/IMG_1.png" for name in unused))
    files = find_mask_files(paths, tmp_path)
    assert files.keeping == {paths[k]: tmp_path / name for k, name in used.items()}
    assert not files.moving
    assert sorted(files.unused) == sorted(tmp_path / name for name in unused)


def test_a_folder_that_is_named_is_the_only_one(tmp_path: Path) -> None:
    paths = write(tmp_path, *PLAIN)
    (mask, other, *_) = write(tmp_path, "mine/IMG_0.png", "mine/IMG_1.gif", "masks/IMG_1.png", "segmentation/IMG_2.png")
    files = find_mask_files(paths, tmp_path, tmp_path / "mine")
    assert files.keeping == {paths[0]: mask}
    assert files.unused == [other]
