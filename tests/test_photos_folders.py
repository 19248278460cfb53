"""What a user's folder may hold instead of photos that fit together: what happened, and what to do, is said."""

import sys

import cv2
import numpy as np
import pytest
from photo_folders import exif, planes, with_exif, write_planes
from start_scenes import texture

from kgs.errors import DataError
from kgs.fit.outputs import write_json
from kgs.fit.photos import pose_photos
from kgs.fit.photos.read import blurred, read_photos
from kgs.fit.photos.write import end_move
from kgs.fit.progress import silent

pytest.importorskip("pycolmap")


def refused(folder, *parts, out=None):
    """The message with which a folder is refused; nothing is left behind."""
    place = out or folder.parent / "out"
    with pytest.raises(DataError) as error:
        pose_photos(folder, place, say=lambda line: None)
    assert not [path.name for path in place.glob("*photos*")]
    text = str(error.value)
    for part in parts:
        assert part in text, text
    return text


def small(images):
    return [cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA) for image in images]


def save(folder, images, names=None):
    folder.mkdir(exist_ok=True)
    for name, image in zip(names or [f"{i}.png" for i in range(len(images))], images, strict=True):
        cv2.imwrite(str(folder / name), image)
    return folder


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "photos"
    path.mkdir()
    return path


def test_no_folder(tmp_path):
    refused(tmp_path / "none", "found no such folder")


def test_an_empty_folder(folder):
    (folder / "notes.txt").write_text("nothing")
    refused(folder, "expected photos", ".jpg", "found none", "Take 3 to 12 photos")


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_photos(folder, count):
    save(folder, planes()[:count])
    refused(folder, f"at least 3 photos, found {count}", "Take 3 to 12")


def test_a_folder_one_level_too_deep(folder):
    save(folder / "DCIM", planes())
    refused(folder, "these folders in it do: DCIM")


def test_photos_of_a_kind_that_is_not_read(folder):
    save(folder, planes())
    (folder / "raw.dng").write_bytes(b"II*\0")
    refused(folder, "1 of 4 photos cannot be read (raw.dng)", "sips", "magick", "Most Compatible")


def test_a_video_that_is_called_jpeg(folder):
    save(folder, planes())
    (folder / "z.jpg").write_bytes(b"\0\0\0\x18ftypisom" + bytes(100))
    refused(folder, "z.jpg: is a HEIC photo or a video", "sips")


def test_videos(folder):
    (folder / "clip.MOV").write_bytes(b"\0\0\0\x14ftypqt  ")
    refused(folder, "clip.MOV is a video", 'ffmpeg -i "clip.MOV"', "3 to 12 sharp ones")
    refused(folder / "clip.MOV", "is a video", "ffmpeg")


def test_one_photo_twice(folder):
    save(folder, [*planes(), planes()[1]])
    refused(folder, "3.png: is the same photo as 1.png: remove one of them")


def test_one_photo_twice_saved_anew(folder):
    save(folder, [*small(planes()[:2]), *small(planes()[1:2])], ["0.png", "1.png", "2.jpg"])
    refused(folder, "1.png and 2.jpg show the same from the same place: remove one of them")


def test_upright_and_lying_photos(folder):
    save(folder, [*planes(), planes()[0].transpose(1, 0, 2)])
    refused(folder, "2 (240x180: 0.png, 1.png, 2.png; 180x240: 3.png)", "all upright or all lying")


def test_photos_of_several_shapes(folder):
    save(folder, [*planes(), planes()[0][:120]])
    text = refused(folder, "expected photos of one shape, got 2", "240x120: 3.png", "Cropped")
    assert "upright" not in text


def test_photos_of_several_lenses(folder):
    for i, (image, film) in enumerate(zip(planes(), (26, 26, 13), strict=True)):
        jpeg = cv2.imencode(".jpg", image)[1].tobytes()
        (folder / f"{i}.jpg").write_bytes(with_exif(jpeg, exif(film=film)))
    refused(folder, "one focal length, got 2", "13 mm: 2.jpg", "26 mm: 0.jpg, 1.jpg", "without zoom")


def test_photos_without_overlap(folder):
    save(folder, [texture(seed, (220.0, 220.0, 220.0), 120).astype(np.uint8) for seed in range(3)])
    refused(folder, "no two of the 3 photos show enough of the same things", "smaller step", "Matches of each pair")


def test_two_scenes_in_one_folder(folder):
    save(folder, small([*planes()[:2], *planes()[:2, :, ::-1]]))
    text = refused(folder, "2 groups that do not overlap (1: 0.png, 1.png; 2: 2.png, 3.png)", "If they show two scenes")
    rows = [line.split() for line in text.splitlines()[-4:]]
    assert [row[:2] for row in rows] == [["1", "0.png"], ["2", "1.png"], ["3", "2.png"], ["4", "3.png"]]
    assert int(rows[0][3]) == int(rows[1][2]) > 50  # a table is symmetric
    assert max(int(rows[i][j]) for i in (0, 1) for j in (4, 5)) < 30
    assert rows[3][5] == "."


def test_a_camera_that_only_turned(folder):
    """Homographies of one plane, seen from one place: nothing tells the depth."""
    wall, lens = (
        texture(0, (220.0, 220.0, 220.0)).astype(np.uint8),
        np.array([[220.0, 0, 120], [0, 220, 90], [0, 0, 1]]),
    )
    far = np.array([[220.0, 0, 450], [0, 220, 450], [0, 0, 1]])
    turns = [cv2.Rodrigues(np.array([0.02 * i, 0.12 * i, 0.0]))[0] for i in range(3)]
    save(folder, [cv2.warpPerspective(wall, lens @ turn @ np.linalg.inv(far), (240, 180)) for turn in turns])
    refused(folder, "a camera that only turned on the spot, explains all matches", "step to the side", "Matches of")


def test_a_blurred_photo_is_told(folder):
    images = planes()
    images[1] = cv2.GaussianBlur(images[1], (0, 0), 2.0)
    save(folder, images)
    assert [photo.path.name for photo in blurred(read_photos(sorted(folder.iterdir()), silent))] == ["1.png"]


def test_photos_of_several_sizes_are_shrunk_to_the_smallest(folder):
    save(folder, [planes()[0], *(cv2.resize(image, (480, 360)) for image in planes()[1:])])
    photos = read_photos(sorted(folder.iterdir()), silent)
    assert {photo.size for photo in photos} == {(240, 180)}
    large = cv2.resize(planes()[0], (2400, 1800))
    save(folder, [large] * 3)
    assert {photo.size for photo in read_photos(sorted(folder.iterdir()), silent)} == {(1600, 1200)}


def test_results_do_not_go_among_the_photos_or_over_another_scene(folder, tmp_path):
    write_planes(folder)
    refused(folder, "holds the photos themselves: choose another folder", out=folder)
    (tmp_path / "scene" / "sparse").mkdir(parents=True)
    refused(folder, "that kgs did not write", out=tmp_path / "scene")
    (tmp_path / "other").mkdir()
    save(tmp_path / "other" / "images", planes())
    refused(folder, "that kgs did not write", out=tmp_path / "other")


def test_pycolmap_that_is_not_there(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ModuleNotFoundError, match="pycolmap"):
        pose_photos(write_planes(folder), folder.parent / "out")


def test_a_move_that_was_stopped_is_ended(tmp_path):
    """A kill between the renaming of the new folder and the last of its parts."""
    new = tmp_path / "finished-photos"
    (new / "sparse" / "0").mkdir(parents=True)
    save(tmp_path / "images", planes()[:1], ["old.png"])
    save(new / "images", planes()[:1], ["new.png"])
    write_json(new / "photos.json", {"versions": {"kgs": "0"}})
    end_move(tmp_path)
    left = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*"))
    assert left == ["images", "images/new.png", "photos.json", "sparse", "sparse/0"]


def test_a_full_disk_leaves_nothing_behind(folder, monkeypatch):
    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("kgs.fit.photos.pose.write_matches", fail)
    with pytest.raises(OSError, match="No space left"):
        pose_photos(write_planes(folder), folder.parent / "out")
    assert [path.name for path in (folder.parent / "out").iterdir()] == [".lock"]
