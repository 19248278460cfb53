"""What cameras write into photos: orientation, as OpenCV applies it, and focal length, by the rules of CIPA."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from photo_folders import exif, planes, with_exif

from kgs.io.console import silent
from kgs.sfm.exif import Exif, read_exif
from kgs.sfm.read import read_photos

JPEG = cv2.imencode(".jpg", planes()[0], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_as_opencv_turns_them(tmp_path, orientation):
    path = tmp_path / "a.jpg"
    path.write_bytes(with_exif(JPEG, exif(orientation=orientation)))
    (photo,) = read_photos([path], silent)
    expected = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    assert photo.pixels.shape == expected.shape == ((240, 180, 3) if orientation > 4 else (180, 240, 3))
    assert np.abs(photo.pixels.astype(int) - expected).mean() < 2  # two decoders


def png(block):
    chunk = b"eXIf" + block
    content = cv2.imencode(".png", planes()[0])[1].tobytes()
    return content[:33] + struct.pack(">I", len(block)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + content[33:]


def webp(block):
    parts = b"WEBP" + b"VP8 " + struct.pack("<I", 3) + b"abc\0" + b"EXIF" + struct.pack("<I", len(block)) + block
    return b"RIFF" + struct.pack("<I", len(parts)) + parts


CONTAINERS = {"jpeg": lambda block: with_exif(JPEG, block), "png": png, "webp": webp, "tiff": lambda block: block}


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("order", "<>")
def test_tags_are_found_in_every_container(container, order):
    found = read_exif(CONTAINERS[container](exif(order, orientation=6, film=28)))
    assert found == Exif(6, 28.0, None)
    # CIPA DCG-001: the diagonal of the photo to that of the film
    assert found.focal_ratio(3024, 4032) == pytest.approx(28 / np.hypot(36, 24) * np.hypot(3, 4) / 4)


@pytest.mark.parametrize(("orientation", "size"), [(1, (4000, 3000)), (6, (3000, 4000))])
def test_a_focal_length_in_millimetres_counts_where_the_density_of_pixels_is_known(orientation, size):
    # 5 mm on a sensor of 8 x 6 mm: 4000 pixels in 0.8 cm
    found = read_exif(with_exif(JPEG, exif(orientation=orientation, focal=5, density=5000, width=4000)))
    assert found.focal_ratio(*size) == pytest.approx(5 / 8)
    assert read_exif(with_exif(JPEG, exif(focal=5))).focal_ratio(4000, 3000) is None


def test_nothing_and_damage_are_no_metadata():
    block = exif(orientation=6, film=28, focal=5, density=5000, width=4000)
    assert read_exif(JPEG) == read_exif(b"BM") == read_exif(b"") == read_exif(png(b"")) == Exif()
    assert read_exif(with_exif(JPEG, exif(orientation=9))) == Exif()
    for cut in range(len(block)):
        assert read_exif(block[:cut]) in (Exif(), Exif(6), read_exif(block))
