"""What a user's folder may hold instead of photos that fit together: what happened, and what to do, is said."""

import os
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
from command import run as command
from init_point_scenes import cameras, texture
from limits import limited
from photo_folders import close, notes_of, open_photos, planes, write_photos, write_planes

from kgs._support.errors import DataError
from kgs._support.progress import silent
from kgs.app.files.results import Results
from kgs.app.sfm import pose, pose_photos
from kgs.app.sfm.find import find_photos
from kgs.app.sfm.pycolmap_processes import PycolmapProcesses
from kgs.app.sfm.read import read_photos
from kgs.app.sfm.source import Source

pytest.importorskip("pycolmap")


@pytest.fixture
def refused(capsys):
    """Runs `kgs fit` on a folder that is refused; the message. Nothing half-made is left behind."""

    def run(folder, *parts, out=None, code=4, kept=False, options=()):
        results = out or folder.parent / "out"
        assert command("fit", folder, "-o", results, *options) == code
        assert kept or not [path.name for path in results.glob("*photos*")]
        text = capsys.readouterr().err
        assert "Traceback" not in text
        for part in parts:
            assert part in text, text
        return text

    return run


def small(images):
    return [cv2.resize(image, (160, 120), interpolation=cv2.INTER_AREA) for image in images]


def save(folder, images, names=None, **others):
    """Write images, and files `stem_suffix=content` of other kinds beside them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(names or [f"{i}.png" for i in range(len(images))], images, strict=True):
        cv2.imwrite(str(folder / name), image)
    for name, content in others.items():
        (folder / ".".join(name.rsplit("_", 1))).write_bytes(content)
    return folder


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "photos"
    path.mkdir()
    return path


VIDEO = b"\0\0\0\x18ftypisom" + bytes(100)
FOLDERS = {  # what is in them, and what is said of it
    "notes": (lambda at: save(at, [], notes_txt=b"nothing"), ("expected photos", ".jpg", "Take 3 to 12 photos")),
    "too deep, with cameras": (
        lambda at: save(save(at, [], transform_train_json=b"{}") / "images", planes()),
        ("these folders in it hold some: images", "transform_train.json"),
    ),
    "video called JPEG": (
        lambda at: save(at, planes(), z_jpg=VIDEO),
        ("z.jpg: expected a photo, got a HEIC", "sips"),
    ),
    "empty": (lambda at: save(at, planes(), z_jpg=b""), ("z.jpg: expected an image, got an empty file",)),
    "videos": (
        lambda at: save(at, [], clip_MOV=VIDEO, other_mp4=VIDEO),
        ("got videos (clip.MOV, other.mp4): name one",),
    ),
}
REFUSED = {  # photos that can be read
    "one twice": (
        lambda at: save(at, [*planes()[:2], planes()[1]]),
        ("2.png: expected another photo than 1.png, got the same: ",),
    ),
    "cropped": (
        lambda at: save(at, [*planes()[:2], planes()[0][:120]]),
        ("expected photos of one shape, got 2", "240x120: 2.png", "Cropped"),
    ),
}
SLOW_REFUSED = {
    "one twice, saved again": (
        lambda at: save(at, [*small(planes()[:2]), *small(planes()[1:2])], ["0.png", "1.png", "2.jpg"]),
        ("1.png and 2.jpg match at the same pixels", "remove one of them"),
    ),
    "no overlap": (
        lambda at: save(at, [texture(seed, (220.0, 220.0, 220.0), 120).astype(np.uint8) for seed in range(3)]),
        ("no two of the 3 photos show enough of the same things", "smaller step", "Matches of each pair"),
    ),
    "close together": (
        lambda at: write_photos(at, close(0.5)),
        ("do not tell the focal length", "3 to 20 degrees apart", "Matches of each pair"),
    ),
}


@pytest.mark.parametrize("kind", FOLDERS)
def test_what_a_folder_holds_instead_is_told(tmp_path, refused, kind):
    fill, said = FOLDERS[kind]
    fill(tmp_path / "photos")
    refused(tmp_path / "photos", *said, code=3)


@pytest.mark.parametrize("kind", [*REFUSED, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW_REFUSED)])
def test_why_photos_are_refused_is_told(tmp_path, refused, kind):
    fill, said = (REFUSED | SLOW_REFUSED)[kind]
    fill(tmp_path / "photos")
    refused(tmp_path / "photos", *said)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
@pytest.mark.parametrize("name", ["3.png", "3.jfif", "3.dng"])
def test_a_link_to_a_photo_that_is_gone(folder, refused, name):
    save(folder, small(planes()))
    (folder / name).symlink_to("gone")
    refused(folder, f"links to files that are not there: {name}", code=3)


@pytest.mark.parametrize("heic", [True, False])
def test_a_raw_file_beside_its_photo_is_passed_over(folder, heic, monkeypatch):
    monkeypatch.setattr("kgs.datasets.folders.has_heic", lambda: heic)
    save(folder, planes())
    for name in ("0.DNG", "1.dng", "2.HEIC"):
        (folder / name).write_bytes(b"II*\0")
    assert [path.name for path in find_photos(folder)] == ["0.png", "1.png", "2.png"]
    said = " ".join(notes_of(folder))
    for name in ("0.DNG", "1.dng", "2.HEIC"):
        assert name in said


@pytest.mark.parametrize("suffix", ["jfif", "JPE", "jif", "pjpeg", "Jpeg", "TIF", "dib", "webp"])
def test_a_photo_is_taken_whatever_its_ending_is_called(folder, suffix):
    save(folder, planes())
    kind = {"dib": "bmp", "webp": "webp", "TIF": "tiff"}.get(suffix, "jpg")
    (folder / f"3.{suffix}").write_bytes(cv2.imencode(f".{kind}", planes()[0])[1].tobytes())
    paths = find_photos(folder)
    assert paths[-1].name == f"3.{suffix}"
    assert len(read_photos(open_photos(paths), silent)) == 4
    assert not notes_of(folder)


@pytest.mark.parametrize("suffix", ["avif", "JXL", "jp2", "gif", "pef", "ppm", "mpo"])
def test_a_photo_of_another_kind_is_named(folder, suffix):
    save(folder, planes())
    (folder / f"3.{suffix}").write_bytes(b"any")
    with pytest.raises(DataError, match=rf"got 1 of 4 of another kind \(3\.{suffix}\)"):
        find_photos(folder)


def fill_with_odd_ones(folder):
    jpeg = cv2.imencode(".jpg", planes()[0])[1].tobytes()
    for name in ("IMG_4", ".IMG_5.jpg", "IMG_6.jpg_original", "._IMG_7.jpg", "notes.txt", "BM.txt", "IMG_8.xmp"):
        (folder / name).write_bytes(jpeg if name[-1] in "4l" or name == ".IMG_5.jpg" else b"BM or other notes")
    (folder / "._IMG_7.jpg").write_bytes(b"\0\5\x16\7" + bytes(100))  # of macOS, beside each file on a foreign disk
    (folder / "IMG_9.jpg").mkdir()
    save(folder / "more", planes()[:1])
    (folder / "empty").mkdir()


def test_what_looks_like_a_photo_and_is_not_taken_is_named(folder, refused):
    fill_with_odd_ones(folder)
    said = refused(folder.rename(folder.with_name("none")), "these folders in it hold some: more", "IMG_4", code=3)
    fill_with_odd_ones(save(folder, planes()))
    assert [path.name for path in find_photos(folder)] == ["0.png", "1.png", "2.png"]
    said = " ".join(notes_of(folder))
    for name in ("IMG_4", ".IMG_5.jpg", "IMG_6.jpg_original", "IMG_9.jpg", "more", "IMG_8.xmp"):
        assert name in said
    for name in ("IMG_7", "notes", "BM.txt", "empty"):
        assert name not in said


def test_masks_are_used_and_what_looks_like_one_is_no_photo(folder):
    save(folder, planes())
    mask = np.full((180, 240), 255, np.uint8)
    mask[:, :40] = 0
    save(folder / "masks", [mask], ["0.png.png"])
    save(folder, [mask], ["1_mask.png"])
    paths = find_photos(folder)
    assert [path.name for path in paths] == ["0.png", "1.png", "2.png"]
    photos = read_photos(open_photos(paths), silent)
    np.testing.assert_array_equal(photos[0].mask, mask)
    assert photos[1].mask is None
    (note,) = notes_of(folder)
    assert "1_mask.png" in note


def test_what_is_called_like_masks_and_is_not_used_is_named(folder):
    save(save(folder, planes()) / "segmentation", planes()[:1])
    lone = ["0 (mask).png", "0_seg.png", "9_mask.png", "mask.png"]
    save(folder, [planes()[0]] * 4, lone)
    assert len(find_photos(folder)) == 7
    unused, taken = notes_of(folder)
    assert "segmentation" in unused
    assert "--masks" in unused
    assert f"{', '.join(lone[:3])} and 1 more" in taken
    assert notes_of(folder, folder / "segmentation") == [taken]


def test_a_camera_that_only_turned(folder, refused):
    """Homographies of one plane, seen from one place: nothing tells the depth."""
    wall, lens = (
        texture(0, (220.0, 220.0, 220.0)).astype(np.uint8),
        np.array([[220.0, 0, 120], [0, 220, 90], [0, 0, 1]]),
    )
    far = np.array([[220.0, 0, 450], [0, 220, 450], [0, 0, 1]])
    turns = [cv2.Rodrigues(np.array([0.02 * i, 0.12 * i, 0.0]))[0] for i in range(3)]
    save(folder, [cv2.warpPerspective(wall, lens @ turn @ np.linalg.inv(far), (240, 180)) for turn in turns])
    refused(folder, "a camera that only turned on the spot, explains all matches", "step to the side", "Matches of")


@pytest.mark.slow
def test_walking_forward(tmp_path, refused):
    images = planes(cameras(np.array([[0.02, 0.0, -0.2], [0.0, 0.02, 0.0], [-0.02, 0.0, 0.2]]), 0.01))
    text = refused(write_photos(tmp_path / "photos", images), "step sideways, not forward", "Matches of each pair")
    assert "places between" not in text


def test_photos_that_lie_where_results_go_are_refused(tmp_path, found):
    pose_photos(write_planes(tmp_path / "photos"), tmp_path / "out")
    images = tmp_path / "out" / "images"
    before = {path.name: path.read_bytes() for path in images.iterdir()}
    with pytest.raises(DataError, match="another folder than that of the photos"):
        pose_photos(images, tmp_path / "out")
    assert {path.name: path.read_bytes() for path in images.iterdir()} == before


@pytest.fixture
def found(monkeypatch):
    """The numbers of photos whose cameras were found, which takes no time."""
    counts = []

    def find(opened, new, *_):
        paths = [photo.path for photo in opened]
        counts.append(len(paths))
        (new / "images").mkdir()
        (new / "sparse" / "0").mkdir(parents=True)
        for path in paths:
            (new / "images" / path.name).write_bytes(b"photo")
        if any(photo.mask for photo in opened):
            (new / "masks").mkdir()
            for path in paths:
                (new / "masks" / f"{path.name}.png").write_bytes(b"mask")
        for name in ("cameras", "images", "points3D"):
            (new / "sparse" / "0" / f"{name}.bin").write_bytes(bytes([len(paths)]))
        return {"photos": {path.name: {"image": path.name} for path in paths}, "versions": {"kgs": "0"}}

    monkeypatch.setattr(pose, "find_cameras", find)
    return counts


def test_other_masks_make_other_cameras(folder, tmp_path, found):
    save(write_planes(folder) / "masks", [np.full((180, 240), 255, np.uint8)], ["IMG_1.png"])
    assert [pose_photos(folder, tmp_path / "out")["reused"] for _ in range(2)] == [False, True]
    (folder / "masks" / "IMG_1.png").unlink()
    assert not pose_photos(folder, tmp_path / "out")["reused"]


def test_results_that_are_lost_are_made_again(folder, tmp_path, found):
    out = tmp_path / "out"
    pose_photos(write_planes(folder), out)
    for name in ("sparse/0/cameras.bin", "images/IMG_1.png"):
        (out / name).unlink()
        assert not pose_photos(folder, out)["reused"]
        assert (out / name).exists()
    assert pose_photos(folder, out)["reused"]


def test_new_cameras_wait_beside_the_fit_of_the_former_ones(folder, found):
    """Until the new fit is there `OUT` has a splat and the cameras that belong to it."""
    out = folder.parent / "out"
    waiting = out / "unfinished"

    def published():
        """How many photos the published cameras are of."""
        return (out / "sparse" / "0" / "cameras.bin").read_bytes()[0], len(list((out / "images").iterdir()))

    def pose_for_fit():
        source = Source.open(folder)
        with Results.open(out, "fit", ["photos"]) as results:
            return pose.pose(source, results, seed=0, masks=None, frames=None, for_fit=True)

    assert pose_photos(write_planes(folder), out)["folder"] == str(out)
    assert pose_for_fit()["folder"] == str(out)
    assert published() == (3, 3)
    save(folder, planes()[:1, 20:], ["IMG_4.png"])
    for reused in (False, True):
        report = pose_for_fit()
        assert (report["reused"], report["folder"]) == (reused, str(waiting))
        assert len(report["photos"]) == 4
        assert published() == (3, 3)
    (folder / "IMG_4.png").unlink()
    assert pose_for_fit()["folder"] == str(out)  # those of the fit after all
    (waiting / "checkpoint.safetensors").write_bytes(b"of a fit to the four")
    save(folder, planes()[:1, 20:40], ["IMG_5.png"])
    with pytest.raises(DataError, match="one of other photos"):
        pose_for_fit()
    with Results.open(out, "fit", ["photos"]) as results:
        results.publish("fit", "photos")
    assert published() == (4, 4)
    assert not waiting.exists()
    assert found == [3, 4]


NOT_FOUND = "kgs: stopped: the cameras were not found yet, and nothing was written\n"


@pytest.mark.parametrize("stage", ["pose.write_images", "accept.write_matches"])
@pytest.mark.parametrize(
    ("error", "code", "said"),
    [(OSError(28, "No space left on device"), 1, "No space left on device"), (KeyboardInterrupt(), 130, NOT_FOUND)],
)
def test_a_full_disk_and_ctrl_c_leave_nothing_behind(folder, monkeypatch, refused, stage, error, code, said):
    def fail(*arguments):
        raise error

    monkeypatch.setattr(f"kgs.app.sfm.{stage}", fail)
    refused(write_planes(folder), said, code=code)
    assert not (folder.parent / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("size", [250_000, 600_000])
def test_a_disk_that_is_full_when_a_database_is_written(folder, refused, size):
    """The first of two, in this process; and the second, in another one that it aborts."""
    with limited(size):
        said = refused(write_planes(folder), code=1).splitlines()
    assert said[-1].startswith(f"kgs: {folder.parent}/out/")
    assert said[-1].endswith(": File too large")
    assert all(" of 3 " in line for line in said[:-1])  # how far the work was
    assert not (folder.parent / "out").exists()


@pytest.mark.slow
def test_ctrl_c_while_keypoints_are_matched(folder, tmp_path):
    save(folder, [cv2.resize(image, (1600, 1200)) for image in planes()])
    words = [sys.executable, "-c", "import kgs.app.cli; kgs.app.cli.main()", "fit", folder, "-o", tmp_path / "out"]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        lines = iter(process.stderr.readline, "")
        assert any(line.startswith("keypoints: ") for line in lines)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.wait(20) == 130
        said = list(lines)
    assert said[-1] == NOT_FOUND
    assert not [line for line in said[:-1] if " of 3 " not in line]
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_neither_solver_sees_what_alpha_hides(folder, tmp_path, monkeypatch):
    shown = []

    def look(process, step, database, images="", lenses=(), **_):
        names = sorted(name for of_lens, _ in lenses for name in of_lens)
        shown.extend(cv2.imread(f"{images}/{name}", cv2.IMREAD_UNCHANGED) for name in names)
        raise RuntimeError("that is enough")

    monkeypatch.setattr(PycolmapProcesses, "run", look)
    images = planes()
    alpha = np.full((*images.shape[:3], 1), 255, np.uint8)
    alpha[:, :60] = 0
    save(folder, np.concatenate([images, alpha], 3))
    with pytest.raises(RuntimeError, match="that is enough"):
        pose_photos(folder, tmp_path / "out")
    assert len(shown) == len(images)
    for seen, image in zip(shown, images, strict=True):
        assert seen.shape[2] == 3
        assert not seen[:60].any()
        assert np.array_equal(seen[60:], image[60:])
