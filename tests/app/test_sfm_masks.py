"""Masks of unposed photos: nothing is matched where they are black, and the scene has them."""

import cv2
import numpy as np
import pytest
from photo_folders import NAMES, exif, planes, with_exif, write_planes

from kgs._support.progress import silent
from kgs.app.sfm import pose_photos
from kgs.app.sfm.read import open_photos, read_photos
from kgs.datasets import load_scene

pycolmap = pytest.importorskip("pycolmap")


def left_is_black(width: int = 240, height: int = 180) -> np.ndarray:
    mask = np.full((height, width), 255, np.uint8)
    mask[:, : width // 6] = 0
    return mask


def test_nothing_is_matched_where_a_mask_is_black(tmp_path):
    photos = write_planes(tmp_path / "photos")
    (photos / "masks").mkdir()
    for name in NAMES[:2]:
        cv2.imwrite(str(photos / "masks" / name), left_is_black())
    pose_photos(photos, tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "0")
    keypoints = {
        image.name: np.array([point.xy for point in image.points2D if point.has_point3D()])
        for image in model.images.values()
    }
    for name in NAMES[:2]:
        assert keypoints[name][:, 0].min() >= 39
    assert keypoints[NAMES[2]][:, 0].min() < 39
    valid = load_scene(tmp_path / "out", hold_out=0).train.valid_mask
    assert valid is not None
    assert valid.float().mean((1, 2)).tolist() == pytest.approx([5 / 6, 5 / 6, 1.0], abs=0.02)
    assert pose_photos(photos, tmp_path / "out")["reused"]
    (photos / "masks" / NAMES[0]).unlink()
    assert not pose_photos(photos, tmp_path / "out")["reused"]  # the masks changed
    assert sorted(path.name for path in (tmp_path / "out" / "masks").iterdir()) == [f"{name}.png" for name in NAMES]


@pytest.mark.parametrize("stored", [False, True])
def test_a_mask_is_upright_or_as_the_photo_is_stored(tmp_path, stored):
    """Of a photo that its Exif turns by 90 degrees."""
    upright = planes()[0]
    jpeg = cv2.imencode(".jpg", np.rot90(upright))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(with_exif(jpeg, exif(orientation=6)))
    (tmp_path / "masks").mkdir()
    mask = left_is_black()
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), np.rot90(mask) if stored else mask)
    (photo,) = read_photos(open_photos([tmp_path / "a.jpg"], tmp_path / "masks"), silent)
    assert photo.size == (240, 180)
    assert np.array_equal(photo.mask, mask)


@pytest.mark.parametrize("kind", ["alpha", "mask", "both"])
def test_a_colour_that_is_hidden_does_not_show_in_a_reduced_photo(tmp_path, kind):
    """One colour is seen, another is hidden: at the border only the first one shows."""
    height, width = 1700, 1900
    y, x = np.mgrid[:height, :width]
    hidden = (np.hypot(x - 900, y - 850) < 501.3) | (x < 33)
    image = np.where(hidden[..., None], np.uint8([0, 255, 0]), np.uint8([30, 60, 200]))
    if kind != "mask":
        image = np.dstack([image, np.where(hidden & (kind == "alpha") | (y > 1600), 0, 255).astype(np.uint8)])
    cv2.imwrite(str(tmp_path / "a.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if kind != "alpha":
        (tmp_path / "masks").mkdir()
        cv2.imwrite(str(tmp_path / "masks" / "a.png"), np.where(hidden, 0, 255).astype(np.uint8))
    masks = None if kind == "alpha" else tmp_path / "masks"
    (photo,) = read_photos(open_photos([tmp_path / "a.png"], masks), silent)
    seen = np.ones(photo.pixels.shape[:2], bool) if photo.mask is None else photo.mask > 0
    if not photo.is_opaque:
        seen &= photo.pixels[..., 3] > 0
        assert not photo.pixels[photo.pixels[..., 3] == 0].any()
    assert 0.5 < seen.mean() < 0.95
    assert np.abs(photo.pixels[seen][:, :3].astype(int) - [200, 60, 30]).max() <= 1
