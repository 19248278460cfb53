"""One unsuitable photo stops nothing: which ones are left out, and of which the middle is taken."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from photo_folders import planes, write_photos
from solved_cameras import solved as cameras

from kgs._support.progress import silent
from kgs.app.sfm.gates import MAX_DEGREES, gap
from kgs.app.sfm.leave_out import unlike_others, without_cameras, without_overlap
from kgs.app.sfm.map import PairGeometry
from kgs.app.sfm.match import lenses_of
from kgs.app.sfm.read import open_photos, read_photos

NAMES = list("abcdef")
PAIRS = dict.fromkeys(pairwise(NAMES), 200)
DEEP = dict.fromkeys(PAIRS, PairGeometry(30.0, 0.5))


def test_a_photo_of_another_place_or_from_the_same_place():
    assert without_overlap(NAMES, PAIRS, DEEP) == {}
    (name, why), *rest = without_overlap(NAMES, PAIRS | {("e", "f"): 29}, DEEP).items()
    assert (name, rest) == ("f", [])
    assert "at most 29 matches" in why
    assert "between e and f" in why
    (name, why), *rest = without_overlap(NAMES, PAIRS | {("a", "b"): 0}, DEEP).items()
    assert (name, rest) == ("a", [])
    assert "shows nothing that the others show" in why
    beside = PAIRS | {("a", "c"): 200}
    assert without_overlap(NAMES, beside, DEEP | {("a", "b"): PairGeometry(0.4, 1.0)}).keys() == {"b"}


def test_three_photos_remain_and_more_than_in_any_other_group():
    halves = PAIRS | {("c", "d"): 0}
    assert without_overlap(NAMES, halves, DEEP) == {}
    assert without_overlap(NAMES[:5], {p: n for p, n in halves.items() if "f" not in p}, DEEP).keys() == {"d", "e"}
    watermark = dict.fromkeys(PAIRS, PairGeometry(0.0, 1.0))
    assert without_overlap(NAMES, PAIRS, watermark) == {}


@pytest.mark.parametrize(
    ("first", "second", "left", "said"),
    [
        (cameras(NAMES), cameras(NAMES), "", ""),
        (cameras(NAMES[1:]), cameras(NAMES[1:]), "a", "neither of two solvers"),
        (cameras(NAMES[1:]), cameras(NAMES[:5]), "af", "only one of two solvers"),
        (cameras(NAMES, points={"c": 49}), cameras(NAMES, points={"c": 20}), "c", "only 49 points"),
        (cameras(NAMES, points={"c": 49}), cameras(NAMES), "", ""),  # one solver sees it well, the other confirms it
        (cameras(NAMES), cameras(NAMES, turned={"d": 2 * MAX_DEGREES}), "d", "4 degrees apart"),
        (cameras(NAMES), cameras(NAMES, turned={"d": 40.0, "e": 80.0}), "de", "degrees apart"),
        (cameras(NAMES), cameras(NAMES, turned={"d": 0.9 * MAX_DEGREES}), "", ""),
        (cameras(NAMES[1:]), cameras(NAMES[1:], turned={"d": 40.0}), "a", "neither"),  # d is looked at without a
        (cameras(NAMES), cameras(NAMES, turned={n: 10.0 * i for i, n in enumerate(NAMES)}), "", ""),  # no three agree
        (cameras(NAMES[:4]), cameras(NAMES[2:]), "", ""),  # two would remain
        (
            cameras(NAMES, focals={"e": 1200.0}),
            cameras(NAMES, focals={"e": 1600.0}),
            "e",
            "factor of 1.33 about the focal length",
        ),
        (cameras(NAMES, focals={"e": 1200.0}), cameras(NAMES, focals={"e": 1250.0}), "", ""),
        (cameras(NAMES), None, "", ""),
    ],
)
def test_photos_without_cameras_that_can_be_trusted(first, second, left, said):
    found = without_cameras([first, second], NAMES, PAIRS)
    assert "".join(sorted(found)) == left
    assert all(said in why for why in found.values())


def test_the_gap_is_beside_the_photo_that_was_not_registered():
    assert gap("f", NAMES[:5], PAIRS) == ("e", "f")
    assert gap("a", NAMES[1:], PAIRS) == ("a", "b")
    assert gap("c", ["a", "b", "d"], {("a", "c"): 20}) == ("a", "c")  # most matches
    assert gap("c", ["a", "b", "e"], {}) == ("b", "c")  # next to it in the order in which they were taken


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
    assert [photo.whole is None for photo in photos] == [True] * 3 + [False] * 4
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
