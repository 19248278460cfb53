"""One unsuitable photo stops nothing: which ones are left out, and that the others have their cameras."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from init_point_scenes import cameras as views
from kornia.geometry.camera import PinholeCamera
from photo_folders import exif, planes, with_exif

from kgs._support.progress import silent
from kgs.app.sfm import pose_photos
from kgs.app.sfm.gates import MAX_DEGREES, gap
from kgs.app.sfm.leave_out import unlike_others, without_cameras, without_overlap
from kgs.app.sfm.map import Cameras, PairGeometry
from kgs.app.sfm.match import lenses_of
from kgs.app.sfm.read import open_photos, read_photos
from kgs.datasets import load_scene
from kgs.geometry import degrees_between

NAMES = list("abcdef")
PAIRS = dict.fromkeys(pairwise(NAMES), 200)
DEEP = dict.fromkeys(PAIRS, PairGeometry(30.0, 0.5))


def cameras(names=NAMES, points=None, turned=None, focals=None):
    """Cameras of these photos, where those in `turned` are turned by so many degrees."""
    turns = dict.fromkeys(names, 0.0) | (turned or {})
    rotations = {name: cv2.Rodrigues(np.array([0.0, np.radians(turns[name]), 0.0]))[0] for name in names}
    counts = dict.fromkeys(names, 90) | (points or {})
    lenses = dict.fromkeys(names, 800.0) | (focals or {})
    return Cameras(lenses, rotations, dict.fromkeys(names, np.zeros(3)), counts, None, 0.1)


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
        (cameras(), cameras(), "", ""),
        (cameras(NAMES[1:]), cameras(NAMES[1:]), "a", "neither of two solvers"),
        (cameras(NAMES[1:]), cameras(NAMES[:5]), "af", "only one of two solvers"),
        (cameras(points={"c": 49}), cameras(points={"c": 20}), "c", "only 49 points"),
        (cameras(points={"c": 49}), cameras(), "", ""),  # one solver sees it well, the other confirms it
        (cameras(), cameras(turned={"d": 2 * MAX_DEGREES}), "d", "4 degrees apart"),
        (cameras(), cameras(turned={"d": 40.0, "e": 80.0}), "de", "degrees apart"),
        (cameras(), cameras(turned={"d": 0.9 * MAX_DEGREES}), "", ""),
        (cameras(NAMES[1:]), cameras(NAMES[1:], turned={"d": 40.0}), "a", "neither"),  # d is looked at without a
        (cameras(), cameras(turned={n: 10.0 * i for i, n in enumerate(NAMES)}), "", ""),  # no three agree
        (cameras(NAMES[:4]), cameras(NAMES[2:]), "", ""),  # two would remain
        (cameras(focals={"e": 1200.0}), cameras(focals={"e": 1600.0}), "e", "factor of 1.33 about the focal length"),
        (cameras(focals={"e": 1200.0}), cameras(focals={"e": 1250.0}), "", ""),
        (cameras(), None, "", ""),
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


def folder_of(folder: Path, images, films=None) -> list[Path]:
    paths = []
    for i, image in enumerate(images):
        jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        path = folder / f"{i}.jpg"
        path.write_bytes(with_exif(jpeg, exif(film=films[i] if films else 0)))
        paths.append(path)
    return paths


def test_copies_and_photos_of_another_shape(tmp_path):
    whole = list(planes())
    images = [*whole, whole[1], whole[0][:120], 255 - whole[2]]
    left = unlike_others(open_photos(folder_of(tmp_path, images, films=[26, 26, 26, 26, 0, 13])))
    assert left.keys() == {"3.jpg", "4.jpg"}
    assert "same photo as 1.jpg" in left["3.jpg"]
    assert "240x120, not 240x180" in left["4.jpg"]
    assert unlike_others(open_photos(folder_of(tmp_path, images, films=[26] * 6))).keys() == {"3.jpg"}


def test_each_focal_length_of_the_exif_is_a_lens(tmp_path):
    images = [*planes(), 255 - planes()[0], 255 - planes()[1]]
    opened = open_photos(folder_of(tmp_path, images, films=[13, 26, 27, 0, 26]))
    photos = read_photos(opened, silent)
    assert [photo.lens for photo in photos] == [1, 0, 0, 0, 0]
    focal = 26 / np.hypot(36, 24) * np.hypot(240, 180)
    assert [lens.focal_length for lens in lenses_of(photos)] == pytest.approx([focal, focal / 2])


def test_of_a_photo_of_another_shape_the_middle_is_taken(tmp_path):
    """With a lens and a mask of its own, upright or lying, reduced or not."""
    whole = list(planes())
    high = np.ascontiguousarray(np.rot90(whole[2][30:150]))
    images = [*whole, whole[0][:, 30:210], whole[1][30:150], high, cv2.resize(whole[2][:90], (720, 270))]
    films = [26, 26, 0, 26, 26, 26, 26]
    paths = folder_of(tmp_path, images, films)
    (tmp_path / "masks").mkdir()
    mask = np.zeros((120, 240), np.uint8)
    mask[:, :120] = 255
    cv2.imwrite(str(tmp_path / "masks" / "4.png"), mask)
    photos = read_photos(open_photos(paths, tmp_path / "masks"), silent)
    assert [photo.size for photo in photos] == [photos[0].size] * 7
    assert [photo.whole is None for photo in photos] == [True] * 3 + [False] * 4
    assert len({photo.lens for photo in photos[:3]}) == 1
    assert len({photo.lens for photo in photos}) == 4  # 240x120 is there upright and lying
    width, height = photos[0].size
    scale = height / 120
    for i, rows, columns in ((4, slice(0, 120), slice(40, 200)), (3, slice(22, 157), slice(0, 180))):
        grey = cv2.cvtColor(cv2.imread(str(paths[i])), cv2.COLOR_BGR2GRAY)[rows, columns]
        middle = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        difference = np.abs(photos[i].grey().astype(int) - middle)
        assert difference.mean() <= (0.5 if i == 4 else 6)  # half a pixel for the square one
    assert np.abs(photos[5].pixels.astype(int) - np.rot90(photos[5].upright().pixels, -1)).max() == 0
    assert (photos[4].mask[:, : width // 2] == 255).all()
    assert (photos[4].mask[:, width // 2 + 1 :] == 0).all()
    assert photos[4].focal == pytest.approx(26 / np.hypot(36, 24) * np.hypot(240, 120) * scale)
    assert photos[5].focal == pytest.approx(photos[4].focal)


def test_a_wide_photo_beside_others_is_registered(tmp_path):
    """A third of its height is missing: the cameras are those of the whole photos."""
    pytest.importorskip("pycolmap")
    whole = list(planes())
    report = {}
    for name, images in (("whole", whole), ("wide", [whole[0], whole[1][22:158], whole[2]])):
        (tmp_path / name).mkdir()
        folder_of(tmp_path / name, images, films=[30, 32 if name == "wide" else 30, 30])
        lines = []
        report[name] = pose_photos(tmp_path / name, tmp_path / f"out-{name}", say=lines.append)
    assert any(line.startswith("1.jpg: only its middle") for line in lines)
    assert report["wide"]["left_out"] == {}
    focals = [photo["focal_px"] for photo in report["wide"]["photos"].values()]
    assert focals[1] / focals[0] == pytest.approx(180 / 136, rel=0.03)
    loaded = {name: load_scene(tmp_path / f"out-{name}", hold_out=0).train.cameras.extrinsics for name in report}
    turns = [poses[1, :3, :3] @ poses[0, :3, :3].T for poses in loaded.values()]
    assert float(degrees_between(*turns)) < 0.5


def test_a_zoomed_photo_gets_a_lens_of_its_own(tmp_path):
    """Where the Exif is a little wrong about it. Three photos of two planes hardly tell two lenses."""
    pytest.importorskip("pycolmap")
    posed = views()
    intrinsics = posed.intrinsics.clone()
    intrinsics[1, :2, :2] *= 1.4
    zoomed = PinholeCamera(intrinsics, posed.extrinsics, posed.height, posed.width)
    paths = folder_of(tmp_path, planes(zoomed), films=[30, 40, 30])
    report = pose_photos(tmp_path, tmp_path / "out")
    assert report["left_out"] == {}
    focals = [report["photos"][path.name]["focal_px"] for path in paths]
    assert focals[0] == focals[2] == report["focal_px"] == pytest.approx(float(posed.fx[0]), rel=0.1)
    assert focals[1] / focals[0] == pytest.approx(1.4, rel=0.02)
    loaded = load_scene(tmp_path / "out", hold_out=0).train.cameras
    assert loaded.fx.tolist() == pytest.approx(focals, rel=0.01)  # larger where pixels would stay blank
    angles = [degrees_between(*(c.extrinsics[1, :3, :3] @ c.extrinsics[0, :3, :3].T for c in (loaded, posed)))]
    assert max(map(float, angles)) < 0.5


def test_the_others_are_registered_as_if_it_were_not_there(tmp_path):
    """Three photos with one of another place beside them have the cameras of the three."""
    pytest.importorskip("pycolmap")
    blocks = np.random.default_rng(0).integers(0, 255, (45, 60, 3), dtype=np.uint8)
    other = cv2.resize(blocks, (240, 180), interpolation=cv2.INTER_CUBIC)
    for name, images in (("three", planes()), ("four", [*planes(), other])):
        (tmp_path / name).mkdir()
        folder_of(tmp_path / name, images)
    lines = []
    three = pose_photos(tmp_path / "three", tmp_path / "out3")
    four = pose_photos(tmp_path / "four", tmp_path / "out4", say=lines.append)
    assert list(four["photos"]) == list(three["photos"]) == ["0.jpg", "1.jpg", "2.jpg"]
    assert list(four["left_out"]) == ["3.jpg"]
    assert any(line.startswith("left out: 3.jpg: ") for line in lines)
    assert sorted(path.name for path in (tmp_path / "out4" / "images").iterdir()) == ["0.png", "1.png", "2.png"]
    assert four["focal_px"] == pytest.approx(three["focal_px"], rel=0.02)
    again = []
    assert pose_photos(tmp_path / "four", tmp_path / "out4", say=again.append)["reused"]
    assert [line for line in again if "left out" in line] == [line for line in lines if "left out" in line]


def test_upright_and_lying_photos_share_a_lens(tmp_path):
    """Three photos of which one was taken with the camera on its side have the cameras of the three."""
    pycolmap = pytest.importorskip("pycolmap")
    lying = list(planes())
    for name, images in (("lying", lying), ("mixed", [lying[0], np.rot90(lying[1]), lying[2]])):
        (tmp_path / name).mkdir()
        for i, image in enumerate(images):
            cv2.imwrite(str(tmp_path / name / f"{i}.png"), image)
    plain = pose_photos(tmp_path / "lying", tmp_path / "out1")
    mixed = pose_photos(tmp_path / "mixed", tmp_path / "out2")
    assert mixed["left_out"] == {}
    assert mixed["focal_px"] == pytest.approx(plain["focal_px"], rel=0.02)
    model = pycolmap.Reconstruction(tmp_path / "out2" / "sparse" / "0")
    assert sorted((lens.width, lens.height) for lens in model.cameras.values()) == [(180, 240), (240, 180)]
    errors = [
        np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy)
        for image in model.images.values()
        for point in image.points2D
        if point.has_point3D()
    ]
    assert len(errors) > 1000
    assert np.median(errors) < 0.3
    views = load_scene(tmp_path / "out2", hold_out=0).train
    assert views.turned == (False, True, False)
    expected = load_scene(tmp_path / "out1", hold_out=0).train
    assert float((views.images - expected.images).abs().mean()) < 0.005
    turns = [part.cameras.extrinsics[1, :3, :3] @ part.cameras.extrinsics[0, :3, :3].T for part in (views, expected)]
    assert torch.allclose(*turns, atol=0.01)
