"""Photos as they are read: their Exif, by the rules of CIPA, their shapes and lenses, and those unlike the others."""

import io
from functools import partial

import cv2
import numpy as np
import PIL.Image
import pytest
from photo_folders import exif, open_photos, planes, with_exif, write_photos

from kgs._support.errors import DataError
from kgs._support.progress import silent
from kgs.app.sfm.match import lenses_of
from kgs.app.sfm.read import Exif, blurred, read_photos, sharpness, unlike_others
from kgs.datasets.image_file import ImageFile

JPEG = cv2.imencode(".jpg", planes()[0], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_turned_as_opencv_turns_them(tmp_path, orientation):
    path = tmp_path / "a.jpg"
    path.write_bytes(with_exif(JPEG, exif(orientation=orientation)))
    (photo,) = read_photos(open_photos([path]), silent)
    expected = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    assert photo.pixels.shape == expected.shape == ((240, 180, 3) if orientation > 4 else (180, 240, 3))
    assert np.abs(photo.pixels.astype(int) - expected).mean() < 2  # two decoders


def read_exif(folder, data):
    path = folder / "photo"
    path.write_bytes(data)
    return Exif.of(ImageFile(path).metadata.tags)


def saved(format, block):
    """The photo as Pillow writes it with this metadata."""
    file = io.BytesIO()
    PIL.Image.fromarray(planes()[0][..., ::-1]).save(file, format, exif=b"Exif\0\0" + block)
    return file.getvalue()


def tiff(block):
    """The photo in front of the tags of `block`, which stay where they are: in the first directory of the file."""
    order = {"I": "<", "M": ">"}[chr(block[0])]
    plain = io.BytesIO()
    exif = PIL.Image.Exif()
    exif.load(block)
    exif.endian = order
    PIL.Image.fromarray(planes()[0][..., ::-1]).save(plain, "TIFF", exif=exif)
    return plain.getvalue()


CONTAINERS = {
    "jpeg": lambda block: with_exif(JPEG, block),
    "png": partial(saved, "PNG"),
    "webp": partial(saved, "WEBP"),
    "tiff": tiff,
}


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("order", "<>")
def test_tags_are_found_in_every_container(tmp_path, container, order):
    found = read_exif(tmp_path, CONTAINERS[container](exif(order, orientation=6, film=28)))
    assert found == Exif(6, 28.0, None)
    # CIPA DCG-001: the diagonal of the photo to that of the film
    assert found.focal_ratio(3024, 4032) == pytest.approx(28 / np.hypot(36, 24) * np.hypot(3, 4) / 4)


@pytest.mark.parametrize(("orientation", "size"), [(1, (4000, 3000)), (6, (3000, 4000))])
def test_a_focal_length_in_millimetres_counts_where_the_density_of_pixels_is_known(tmp_path, orientation, size):
    # 5 mm on a sensor of 8 x 6 mm: 4000 pixels in 0.8 cm
    block = exif(orientation=orientation, focal=5, density=5000, width=4000)
    assert read_exif(tmp_path, with_exif(JPEG, block)).focal_ratio(*size) == pytest.approx(5 / 8)
    assert read_exif(tmp_path, with_exif(JPEG, exif(focal=5))).focal_ratio(4000, 3000) is None


@pytest.mark.parametrize(
    ("film", "over_width", "expected"),
    [
        (28, None, 28 / 36),
        (1, None, None),
        (7, None, None),
        (8, None, 8 / 36),  # a fisheye
        (360, None, 10),
        (720, None, None),
        (None, 0.1, None),  # of a sensor of another size
        (None, 20, None),
        (1, 0.8, 0.8),
    ],
)
def test_a_focal_length_that_no_lens_has_is_passed_over(tmp_path, film, over_width, expected):
    (photo,) = opened(tmp_path, planes()[:1], [0])
    photo = photo._replace(exif=Exif(1, film, over_width), size=(3600, 2400))
    assert photo.focal_ratio == (expected and pytest.approx(expected))
    assert photo.has_odd_focal == (expected is None)


def test_nothing_and_damage_are_no_metadata(tmp_path):
    block = exif(orientation=6, film=28, focal=5, density=5000, width=4000)
    whole = read_exif(tmp_path, with_exif(JPEG, block))
    assert whole == Exif(6, 28.0, pytest.approx(5 / 8))
    assert read_exif(tmp_path, JPEG) == read_exif(tmp_path, saved("PNG", b"")) == Exif()
    assert read_exif(tmp_path, with_exif(JPEG, exif(orientation=9))) == Exif()
    for cut in range(len(block)):
        found = read_exif(tmp_path, with_exif(JPEG, block[:cut]))
        assert found.orientation in (1, 6)
        assert found.focal_35mm in (None, 28.0)
        assert found.focal_over_width in (None, whole.focal_over_width)


@pytest.mark.parametrize("value", [0, -3.0, float("nan"), float("inf"), (), (0,), None, 10**400, "28", b"28"])
def test_values_that_are_no_positive_number_count_as_missing(value):
    focal = 28.0 if value in ("28", b"28") else None  # a number as text is one
    assert Exif.of({0xA405: value, 0x0112: value}) == Exif(focal_35mm=focal)


def test_a_panorama_is_refused_and_how_to_cut_it_is_said(tmp_path):
    ahead = cv2.resize(planes()[0], (400, 200))
    xmp = b"http://ns.adobe.com/xap/1.0/\0<GPano:ProjectionType>equirectangular</GPano:ProjectionType>"
    for i in range(3):
        jpeg = cv2.imencode(".jpg", np.roll(ahead, 9 * i, 0))[1].tobytes()
        tag = b"\xff\xe1" + (len(xmp) + 2).to_bytes(2, "big") + xmp
        (tmp_path / f"{i}.jpg").write_bytes(jpeg[:2] + tag + jpeg[2:])
    photos = open_photos(sorted(tmp_path.iterdir()))
    assert all(photo.is_panorama for photo in photos)
    with pytest.raises(DataError, match=r"0\.jpg: .* got a panorama: .*v360"):
        unlike_others(photos)
    plain = tmp_path / "plain.png"
    cv2.imwrite(str(plain), ahead)
    (photo,) = open_photos([plain])
    assert not photo.is_panorama  # as wide, and no more


def opened(folder, images, films):
    return open_photos(sorted(write_photos(folder, images, films).glob("*.jpg")))


def test_copies_and_photos_of_another_shape(tmp_path):
    whole = list(planes())
    images = [*whole, whole[1], whole[0][:120], 255 - whole[2]]
    left = unlike_others(opened(tmp_path, images, [26, 26, 26, 26, 0, 13]))
    assert left.keys() == {"IMG_4.jpg", "IMG_5.jpg"}
    assert "same photo as IMG_2.jpg" in left["IMG_4.jpg"]
    assert "240x120, not 240x180" in left["IMG_5.jpg"]
    assert unlike_others(opened(tmp_path, images, [26] * 6)).keys() == {"IMG_4.jpg"}


def test_each_focal_length_of_the_exif_is_a_lens(tmp_path):
    images = [*planes(), 255 - planes()[0], 255 - planes()[1]]
    photos = read_photos(opened(tmp_path, images, [13, 26, 27, 0, 26]), silent)
    assert [photo.lens for photo in photos] == [1, 0, 0, 0, 0]
    focal = 26 / np.hypot(36, 24) * np.hypot(240, 180)
    assert [lens.focal_length for lens in lenses_of(photos)] == pytest.approx([focal, focal / 2])


def test_of_a_photo_of_another_shape_the_middle_is_taken(tmp_path):
    """With a lens and a mask of its own, upright or lying, reduced or not."""
    whole = list(planes())
    high = np.ascontiguousarray(np.rot90(whole[2][30:150]))
    images = [*whole, whole[0][:, 30:210], whole[1][30:150], high, cv2.resize(whole[2][:90], (720, 270))]
    films = [26, 26, 0, 26, 26, 26, 26]
    (tmp_path / "masks").mkdir()
    mask = np.zeros((120, 240), np.uint8)
    mask[:, :120] = 255
    cv2.imwrite(str(tmp_path / "masks" / "IMG_5.png"), mask)
    photos = read_photos(opened(tmp_path, images, films), silent)
    assert [photo.size for photo in photos] == [photos[0].size] * 7
    assert [photo.is_cut for photo in photos] == [False] * 3 + [True] * 4
    assert len({photo.lens for photo in photos[:3]}) == 1
    assert len({photo.lens for photo in photos}) == 4  # 240x120 is there upright and lying
    width, height = photos[0].size
    scale = height / 120
    for i, rows, columns in ((4, slice(0, 120), slice(40, 200)), (3, slice(22, 157), slice(0, 180))):
        grey = cv2.cvtColor(cv2.imread(str(tmp_path / f"IMG_{i + 1}.jpg")), cv2.COLOR_BGR2GRAY)[rows, columns]
        middle = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        difference = np.abs(photos[i].grey().astype(int) - middle)
        assert difference.mean() <= (0.5 if i == 4 else 6)  # half a pixel for the square one
    assert np.abs(photos[5].pixels.astype(int) - np.rot90(photos[5].upright().pixels, -1)).max() == 0
    assert (photos[4].mask[:, : width // 2] == 255).all()
    assert (photos[4].mask[:, width // 2 + 1 :] == 0).all()
    assert photos[4].focal == pytest.approx(26 / np.hypot(36, 24) * np.hypot(240, 120) * scale)
    assert photos[5].focal == pytest.approx(photos[4].focal)


@pytest.mark.parametrize("stored", [False, True])
def test_a_mask_is_upright_or_as_the_photo_is_stored(tmp_path, stored):
    """Of a photo that its Exif turns by 90 degrees."""
    upright = planes()[0]
    jpeg = cv2.imencode(".jpg", np.rot90(upright))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(with_exif(jpeg, exif(orientation=6)))
    (tmp_path / "masks").mkdir()
    mask = np.full((180, 240), 255, np.uint8)
    mask[:, :40] = 0
    cv2.imwrite(str(tmp_path / "masks" / "a.png"), np.rot90(mask) if stored else mask)
    (photo,) = read_photos(open_photos([tmp_path / "a.jpg"], tmp_path / "masks"), silent)
    assert photo.size == (240, 180)
    assert np.array_equal(photo.mask, mask)


@pytest.mark.parametrize("kind", ["alpha", "mask", "both"])
def test_a_colour_that_is_hidden_does_not_show_in_a_reduced_photo(tmp_path, monkeypatch, kind):
    """One colour is seen, another is hidden: at the border only the first one shows."""
    monkeypatch.setattr("kgs.app.sfm.read.LONGEST", 400)
    height, width = 425, 475
    y, x = np.mgrid[:height, :width]
    hidden = (np.hypot(x - 225, y - 212) < 125.3) | (x < 9)
    image = np.where(hidden[..., None], np.uint8([0, 255, 0]), np.uint8([30, 60, 200]))
    if kind != "mask":
        image = np.dstack([image, np.where(hidden & (kind == "alpha") | (y > 400), 0, 255).astype(np.uint8)])
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


def test_a_blurred_photo_is_told(tmp_path):
    images = list(planes())
    images[1] = cv2.GaussianBlur(images[1], (0, 0), 2.0)
    photos = read_photos(opened(tmp_path, images, [0] * 3), silent)
    assert [photo.name for photo in blurred(photos)] == ["IMG_2.jpg"]


def test_what_a_mask_leaves_out_is_neither_sharp_nor_blurred():
    mask = np.full((180, 240), 255, np.uint8)
    mask[40:140, 100:200] = 0
    for hidden in (0, 255, np.random.default_rng(0).integers(0, 256, (180, 240, 3))):
        image = np.where(mask[..., None] > 0, planes()[0], hidden).astype(np.uint8)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        assert sharpness(grey, mask) == sharpness(cv2.cvtColor(planes()[0], cv2.COLOR_BGR2GRAY), mask)


@pytest.mark.parametrize(
    ("sizes", "expected"), [([(240, 180), (480, 360), (480, 360)], (240, 180)), ([(2400, 1800)] * 2, (1600, 1200))]
)
def test_photos_are_shrunk_to_the_smallest_or_to_1600_pixels(tmp_path, sizes, expected):
    images = [cv2.resize(image, size) for image, size in zip(planes(), sizes, strict=False)]
    photos = read_photos(opened(tmp_path, images, [0] * len(sizes)), silent)
    assert {photo.size for photo in photos} == {expected}
