"""Standard downloads in the size of published tables."""

import cv2
import numpy as np
import pytest
import torch
from refusals import refused
from tiny_scenes import write_blender, write_llff, write_llff_rows, write_photos

from kgs import DataError
from kgs.datasets import load_scene
from kgs.datasets.field import field_size

FULL = (2016, 1512)  # the width and height that the cameras are for


@pytest.fixture
def download(tmp_path):
    """Cameras of LLFF for large photos; the test adds folders of photos."""
    write_llff_rows(tmp_path, 3, FULL, focal=1700.0)
    return tmp_path


def loaded(root, **options):
    photo_folder, factor, why = field_size(root)
    assert why
    return load_scene(root, downscale=factor, hold_out=0, photo_folder=photo_folder, **options).train


def test_the_eighth_of_a_download_is_taken_where_it_is(download):
    write_photos(download / "images", size=(504, 378))
    write_photos(download / "images_4", size=(504, 378))
    write_photos(download / "images_8", size=(252, 189))
    views = loaded(download)
    assert views.images.shape[-2:] == (189, 252)
    photo = cv2.imread(str(download / "images_8" / "0.png"))[..., ::-1] / 255.0
    assert np.abs(views.images[0].permute(1, 2, 0).numpy() - photo).max() < 1e-6
    assert torch.allclose(views.cameras.intrinsics[0, 0, 0], torch.tensor(1700.0 / 8))


def test_a_folder_that_is_named_is_taken(download):
    write_photos(download / "images", size=(504, 378))
    write_photos(download / "images_8", size=(252, 189))
    assert load_scene(download, hold_out=0, photo_folder="images_8").train.images.shape[-2:] == (189, 252)
    assert load_scene(download, hold_out=0).train.images.shape[-2:] == (378, 504)
    with refused(DataError, expected="the photos in images_4/"):
        load_scene(download, photo_folder="images_4")


def test_larger_photos_are_reduced_and_the_sentence_says_so(download):
    write_photos(download / "images", size=(504, 378))
    assert field_size(download)[:2] == ("", 2.0)
    assert "504x378 reduced to 252x189" in field_size(download)[2]
    views = loaded(download)
    assert views.images.shape[-2:] == (189, 252)
    photo = cv2.imread(str(download / "images" / "0.png"))[..., ::-1] / 255.0
    averages = photo.reshape(189, 2, 252, 2, 3).mean((1, 3))
    assert np.abs(views.images[0].permute(1, 2, 0).numpy() - averages).max() < 1e-5


def test_photos_of_that_size_stay_as_they_are(download):
    write_photos(download / "images", size=(252, 189))
    assert field_size(download)[:2] == ("", None)


def test_scenes_of_small_photos_stay_as_they_are(tmp_path):
    write_llff(tmp_path)
    assert field_size(tmp_path)[:2] == ("", None)


def test_images_of_blender_are_halved(tmp_path):
    write_blender(tmp_path)
    write_photos(tmp_path / "train", size=(800, 800))
    assert field_size(tmp_path)[:2] == ("", 2.0)
    with pytest.raises(DataError, match="images_8"):
        load_scene(tmp_path, photo_folder="images_8")


def test_a_folder_that_is_no_scene_is_refused(tmp_path):
    with refused(DataError, path=tmp_path, expected="a scene"):
        field_size(tmp_path)
