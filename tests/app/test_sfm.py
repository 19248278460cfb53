"""Cameras from unposed photos: right ones, the same again, in files that other programs read."""

import json
import shutil
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from init_point_scenes import WIDTH, cameras, focal_length
from kornia.geometry.camera import PinholeCamera
from photo_folders import (
    NAMES,
    SMALL,
    close,
    planes,
    small_cameras,
    small_planes,
    write_photos,
    write_planes,
)

from kgs.app.sfm import pose_photos
from kgs.app.sfm.map import Solver
from kgs.app.sfm.write import leveling, write_model
from kgs.datasets import load_scene
from kgs.errors import PhotosRefused
from kgs.geometry.rigs import camera_centers, degrees_between

pycolmap = pytest.importorskip("pycolmap")
FOCAL = focal_length(SMALL[0])
HIDDEN = SMALL[0] // 6  # columns that are black in a mask


def reconstruction(out):
    """As pycolmap reads it."""
    return pycolmap.Reconstruction(out / "sparse" / "0")


@pytest.fixture(scope="module")
def model(posed):
    return reconstruction(posed.out)


def between(poses):
    """The turn from the first camera to the second."""
    return poses[1, :3, :3] @ poses[0, :3, :3].T


def pixel_errors(model):
    """Of all points in all photos."""
    errors = []
    for image in model.images.values():
        for point in image.get_observation_points2D():
            errors.append(np.linalg.norm(image.project_point(model.points3D[point.point3D_id].xyz) - point.xy))
    return errors


def test_the_cameras_are_those_that_took_the_photos(posed):
    report = posed.report
    poses = load_scene(posed.out, hold_out=0).train.cameras.extrinsics, small_cameras().extrinsics
    for pair in combinations(range(3), 2):
        assert float(degrees_between(*(between(of[[*pair]]) for of in poses))) < 0.5
    steps = [camera_centers(of).diff(dim=0).norm(dim=1) for of in poses]
    assert float(steps[0][0] / steps[0][1]) == pytest.approx(float(steps[1][0] / steps[1][1]), rel=0.02)
    assert report["focal_px"] == pytest.approx(FOCAL, rel=0.05)
    assert report["agreement_degrees"] < 1
    assert report["focal_rise"] > 0.05


def test_pycolmap_and_kgs_read_the_same_scene(posed, model):
    _, out, report, _ = posed
    scene = load_scene(out, points="model-points")
    names = [*scene.train.names, *scene.test.names]
    extrinsics = np.concatenate([views.cameras.extrinsics.numpy() for views in (scene.train, scene.test)])
    for name, pose in zip(names, extrinsics, strict=True):
        expected = model.find_image_with_name(name).cam_from_world().matrix()
        offset = expected[:, :3] @ scene.offset.numpy()
        np.testing.assert_allclose(pose[:3, :3], expected[:, :3], atol=1e-6)
        np.testing.assert_allclose(pose[:3, 3], expected[:, 3] + offset, atol=1e-5)
    camera = next(iter(model.cameras.values()))
    assert (camera.width, camera.height) == scene.train.images.shape[:1:-1] == tuple(report["size"])
    assert (camera.model_name, camera.params[0]) == ("SIMPLE_RADIAL", report["focal_px"])
    assert len(model.points3D) == report["points"] > 50
    assert all(point.track.length() >= 2 for point in model.points3D.values())
    colors = np.array([point.color for point in model.points3D.values()])
    assert colors.std(axis=0).min() > 5  # of the photos, not all black


def test_points_project_to_where_the_photos_show_them(posed, model):
    errors = pixel_errors(model)
    assert np.mean(errors) == pytest.approx(posed.report["reprojection_error_px"], rel=0.05)  # COLMAP's is over points
    assert np.median(errors) < 0.5


def test_a_model_that_was_not_written_whole_is_an_error(posed, model, tmp_path):
    """COLMAP's writers do not look whether the disk took what they wrote."""

    class OnAFullDisk:
        def write_binary(self, folder):
            model.write_binary(folder)
            data = (folder / cut).read_bytes()
            (folder / cut).write_bytes(data[: len(data) // 2])

        def extract_colors_for_all_images(self, images):
            """They are there."""

    for cut in ("points3D.bin", "images.bin", "cameras.bin"):
        with pytest.raises(OSError, match="was not written whole"):
            write_model(tmp_path / cut, SimpleNamespace(reconstruction=OnAFullDisk()), posed[1] / "images")


def test_up_is_minus_y_and_the_median_depth_is_one(model):
    rotations = np.array([image.cam_from_world().matrix()[:, :3] for image in model.images.values()])
    up = -rotations[:, 1].sum(0)
    np.testing.assert_allclose(up / np.linalg.norm(up), [0, -1, 0], atol=1e-9)
    depths = []
    for image in model.images.values():
        row = image.cam_from_world().matrix()[2]
        depths += [model.points3D[p.point3D_id].xyz @ row[:3] + row[3] for p in image.get_observation_points2D()]
    assert np.median(depths) == pytest.approx(1)
    assert min(depths) > 0


def test_the_images_are_the_photos(posed):
    for name, image in zip(NAMES, small_planes(), strict=True):
        written = posed[1] / "images" / name
        assert np.array_equal(cv2.imread(str(written)), image)
        assert b"eXIf" not in written.read_bytes()


def test_the_report_says_what_was_found(posed):
    folder, out, report, lines = posed
    written = json.loads((out / "photos.json").read_text())
    assert written == {key: value for key, value in report.items() if key not in ("reused", "folder")}
    assert (report["reused"], report["folder"]) == (False, str(out))
    assert set(report["sha256"]) == set(report["photos"]) == set(NAMES)
    assert {tuple(row[:2]) for row in report["matches"]} == {(a, b) for a in NAMES for b in NAMES if a < b}
    assert min(row[2] for row in report["matches"]) > 50
    assert report["versions"]["pycolmap"] == pycolmap.__version__
    assert report["focal_35mm"] == pytest.approx(report["focal_px"] * 43.2666 / np.hypot(*report["size"]), rel=1e-4)
    assert sorted(path.name for path in out.iterdir()) == [
        ".kgs.json",
        ".kgs.lock",
        "images",
        "photos.json",
        "sparse",
    ]
    assert str(folder) not in (out / "photos.json").read_text()
    assert any("3 photos" in line for line in lines)


@pytest.mark.slow
def test_the_same_photos_and_seed_give_the_same_files(posed, tmp_path):
    folder, out, report, _ = posed
    again = pose_photos(folder, tmp_path / "again")
    for name in [
        *(f"images/{name}" for name in NAMES),
        *(f"sparse/0/{s}.bin" for s in ("cameras", "images", "points3D")),
    ]:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name
    different = {"seconds": None, "folder": None}
    assert again | different == report | different


def test_a_second_run_uses_what_is_there(posed):
    folder, out, _, _ = posed
    lines, before = [], {path: path.stat().st_mtime_ns for path in out.rglob("*.*") if path.name != ".kgs.lock"}
    assert pose_photos(folder, out, say=lines.append)["reused"]
    assert "used again" in lines[0]
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """The same photos, of which the second lies on its side and two have masks, with one of another place."""
    root, lines = tmp_path_factory.mktemp("mixed"), []
    images = list(small_planes())
    images[1] = np.rot90(images[1])
    folder = write_planes(root / "photos", images)
    other = cv2.circle(np.full((*SMALL[::-1], 3), 128, np.uint8), (80, 60), 20, (0, 0, 255), -1)
    cv2.imwrite(str(folder / "IMG_4.png"), other)
    mask = np.full(SMALL[::-1], 255, np.uint8)
    mask[:, :HIDDEN] = 0
    write_planes(folder / "masks", [mask, np.rot90(mask), np.full(SMALL[::-1], 255, np.uint8)])
    (folder / "reconstruction.json").write_text("{}")
    report = pose_photos(folder, root / "out", say=lines.append)
    return folder, root / "out", report, lines


def test_the_others_are_registered_as_if_one_of_another_place_was_not_there(posed, mixed):
    folder, out, report, lines = mixed
    assert "reconstruction.json" in lines[0]
    assert list(report["photos"]) == list(NAMES)
    assert list(report["left_out"]) == ["IMG_4.png"]
    assert sorted(path.name for path in (out / "images").iterdir()) == [*NAMES]
    assert report["focal_px"] == pytest.approx(posed.report["focal_px"], rel=0.02)
    again = []
    assert pose_photos(folder, out, say=again.append)["reused"]
    said, repeated = ([line for line in each if line.startswith("left out: IMG_4.png: ")] for each in (lines, again))
    assert said == repeated != []


def test_upright_and_lying_photos_share_a_lens(posed, mixed):
    model = reconstruction(mixed[1])
    assert sorted((lens.width, lens.height) for lens in model.cameras.values()) == [SMALL[::-1], SMALL]
    assert len({lens.params[0] for lens in model.cameras.values()}) == 1
    errors = pixel_errors(model)
    assert len(errors) > 1000
    assert np.median(errors) < 0.3
    views, expected = (load_scene(out, hold_out=0).train for out in (mixed[1], posed.out))
    assert views.turned == (False, True, False)
    assert float((views.images - expected.images).abs().mean()) < 0.005
    assert torch.allclose(*(between(part.cameras.extrinsics) for part in (views, expected)), atol=0.01)


def test_nothing_is_matched_where_a_mask_is_black(mixed):
    _, out, _, _ = mixed
    model = reconstruction(out)
    first, _, plain = (
        min(point.xy[0] for point in model.find_image_with_name(name).points2D if point.has_point3D()) for name in NAMES
    )
    lying = min(SMALL[0] - point.xy[1] for point in model.find_image_with_name(NAMES[1]).get_observation_points2D())
    assert min(first, lying) >= HIDDEN - 1
    assert plain < HIDDEN - 1
    valid = load_scene(out, hold_out=0).train.valid_mask
    share = 1 - HIDDEN / SMALL[0]
    assert valid.float().mean((1, 2)).tolist() == pytest.approx([share, share, 1.0], abs=0.02)
    assert sorted(path.name for path in (out / "masks").iterdir()) == [f"{name}.png" for name in NAMES]


def test_a_wide_photo_beside_others_is_registered(tmp_path):
    """A third of its height is missing: the cameras are those of the whole photos."""
    lines, images = [], list(planes())
    images[1] = images[1][22:158]
    report = pose_photos(write_photos(tmp_path / "photos", images, [30, 32, 30]), tmp_path / "out", say=lines.append)
    assert any(line.startswith("IMG_2.jpg: only its middle") for line in lines)
    assert report["left_out"] == {}
    focals = [photo["focal_px"] for photo in report["photos"].values()]
    assert focals[1] / focals[0] == pytest.approx(180 / 136, rel=0.03)
    found = load_scene(tmp_path / "out", hold_out=0).train.cameras.extrinsics
    assert float(degrees_between(between(found), between(cameras().extrinsics))) < 0.5


def test_a_zoomed_photo_gets_a_lens_of_its_own(tmp_path):
    """Where the Exif is a little wrong about it. Three photos of two planes hardly tell two lenses."""
    posed = small_cameras()
    intrinsics = posed.intrinsics.clone()
    intrinsics[1, :2, :2] *= 1.4
    zoomed = PinholeCamera(intrinsics, posed.extrinsics, posed.height, posed.width)
    report = pose_photos(write_photos(tmp_path / "photos", planes(zoomed), [30, 40, 30]), tmp_path / "out")
    assert report["left_out"] == {}
    focals = [photo["focal_px"] for photo in report["photos"].values()]
    assert focals[0] == focals[2] == report["focal_px"] == pytest.approx(FOCAL, rel=0.1)
    assert focals[1] / focals[0] == pytest.approx(1.4, rel=0.02)
    loaded = load_scene(tmp_path / "out", hold_out=0).train.cameras
    assert loaded.fx.tolist() == pytest.approx(focals, rel=0.01)  # larger where pixels would stay blank
    assert float(degrees_between(between(loaded.extrinsics), between(posed.extrinsics))) < 0.5


def test_a_solver_whose_first_pair_leads_nowhere_registers_all_photos(tmp_path, monkeypatch):
    map_once = Solver._run_mapper

    def run_mapper(solver, options, start=""):
        fails = solver.database.stem == "second" and options.init_image_id1 < 0
        return None if fails else map_once(solver, options, start)

    monkeypatch.setattr(Solver, "_run_mapper", run_mapper)
    report = pose_photos(write_planes(tmp_path / "photos", small_planes()), tmp_path / "out")
    assert len(report["photos"]) == 3
    assert report["left_out"] == {}


@pytest.mark.slow
def test_photos_that_are_close_together_take_the_focal_length_of_their_exif(tmp_path):
    lines, folder = [], write_photos(tmp_path / "photos", close(1), [30] * 3)
    report = pose_photos(folder, tmp_path / "out", say=lines.append)
    assert report["focal_px"] == report["exif_focal_px"] == pytest.approx(30 * WIDTH / 34.6, rel=1e-3)
    assert report["focal_rise"] is None
    assert any("the Exif says 208 pixels" in line for line in lines)


@pytest.mark.slow
def test_photos_that_tell_the_focal_length_are_believed_more_than_their_exif(tmp_path):
    report = pose_photos(write_photos(tmp_path / "photos", planes(), [40] * 3), tmp_path / "out", say=lambda line: None)
    assert report["exif_focal_px"] > 1.3 * focal_length(WIDTH)
    assert report["focal_px"] == pytest.approx(focal_length(WIDTH), rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("strength", [0.03, -0.1])
def test_the_distortion_of_the_lens_is_found(tmp_path, strength):
    images = np.stack([distorted(image, strength) for image in planes()])
    report = pose_photos(write_photos(tmp_path / "photos", images), tmp_path / "out", say=lambda line: None)
    assert report["radial_distortion"] == pytest.approx(strength, abs=0.02)
    assert report["focal_px"] == pytest.approx(focal_length(WIDTH), rel=0.05)


def distorted(image: np.ndarray, strength: float) -> np.ndarray:
    """What a lens shows of a pinhole's image that takes points at u to u (1 + strength |u|^2), u over focal length."""
    height, width = image.shape[:2]
    center, focal = np.array([width / 2 - 0.5, height / 2 - 0.5]), focal_length(width)
    shown = (np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) - center) / focal
    straight = shown
    for _ in range(30):
        straight = shown / (1 + strength * np.sum(straight**2, axis=-1, keepdims=True))
    pixels = (straight * focal + center).astype(np.float32)
    return cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "views", "rotation"),
    [("llff/fern", 3, 1.0), ("colmap/trex", 3, 1.0), ("nerfstudio/fox", 6, 1.5), ("nerfstudio/fox", 3, None)],
)
def test_real_photos_against_given_poses(tmp_path, kgs_data, name, views, rotation):
    """Fox 3, photos 42 to 53 degrees apart, has to be refused: its reprojection error is small, and it is wrong."""
    given = load_scene(kgs_data / name, views, photos=False).train
    folder = next(path for path in (kgs_data / name / "images", kgs_data / name / "images_8") if path.is_dir())
    (tmp_path / "photos").mkdir()
    for view in given.names:
        shutil.copy(folder / Path(view).name, tmp_path / "photos")
    if rotation is None:
        with pytest.raises(PhotosRefused, match="cameras can be trusted"):
            pose_photos(tmp_path / "photos", tmp_path / "out")
        return
    pose_photos(tmp_path / "photos", tmp_path / "out")
    found = load_scene(tmp_path / "out", hold_out=0).train
    poses = [
        dict(zip((Path(name).stem for name in views.names), views.cameras.extrinsics.double(), strict=True))
        for views in (found, given)
    ]
    for a, b in combinations(poses[1], 2):
        assert float(degrees_between(*(between(torch.stack([of[a], of[b]])) for of in poses))) < rotation


@pytest.mark.parametrize(
    "vector", [(0.0, -2.0, 0.0), (0.0, 3.0, 0.0), (0.1, 1.0, 0.1), (1.0, 0.2, -3.0), (0.0, 0.0, 1.0)]
)
def test_what_is_up_is_turned_up(vector):
    """An upside-down camera, too: half a turn about its view."""
    vector = np.array(vector)
    turned = leveling(vector)
    np.testing.assert_allclose(turned @ vector, [0, -np.linalg.norm(vector), 0], atol=1e-12)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1.0)
    assert np.trace(leveling(np.zeros(3))) == 3
    assert leveling(np.array([0.0, 1.0, 0.0]))[2, 2] == 1
