"""Finds the cameras of a folder of photos, checks that two solvers agree, and writes the scene and a report."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2

from kgs._support.errors import DataError, listed, printable
from kgs._support.json_files import read_json, write_json
from kgs._support.machine import versions
from kgs._support.progress import ProgressBar, silent
from kgs._support.torch_threads import torch_on_one_thread
from kgs.app.console import each, say
from kgs.app.files.fit_files import has_fit
from kgs.app.files.outputs import png_names
from kgs.app.files.results import Results
from kgs.datasets.folders import CAMERAS_REPORT as REPORT
from kgs.datasets.image_file import color_notes
from kgs.datasets.masks import find_masks

from .accept import (
    FOCAL_RANGE,
    MAX_DEGREES,
    MAX_RATIO,
    MIN_POINTS,
    MIN_RISE,
    Accepted,
    accepted_cameras,
    say_rejected,
)
from .find import notes_on
from .map import Cameras
from .match import exif_focal
from .pycolmap_processes import check_space
from .read import FILM_DIAGONAL, OpenPhoto, Photo, blurred, open_photos, read_photos, unlike_others
from .source import Source
from .video import take_frames
from .write import level_and_scale, upright, write_images, write_masks, write_model

IMAGES = "images"
MASKS = "masks"
MODEL = "sparse/0"
_MODEL_FILES = ("cameras", "images", "points3D")
SETTINGS = 10  # increased by every change after which the same photos give other files


def pose_photos(
    folder: str | PathLike[str],
    out: str | PathLike[str],
    *,
    seed: int = 0,
    masks: str | PathLike[str] | None = None,
    frames: int | None = None,
    bar: ProgressBar = silent,
    say: Callable[[str], None] = say,
) -> dict[str, Any]:
    """Find the cameras of unposed photos, and write a scene that `kgs.datasets.load_scene` reads.

    The folder `out` gets `images` (PNGs as the photos are looked at, at most 1600 pixels long, without metadata),
    `masks` if there are any, `sparse/0` (COLMAP's binary model: a SIMPLE_RADIAL lens for each focal length that the
    Exif tells apart, twice if some photos are upright and some lie; poses, points with tracks) and `photos.json` (the
    report). If a former run had the same photos, masks and seed, its results are used again.

    Convention:
        COLMAP's: world-to-camera poses with OpenCV axes, the first pixel's centre at (0.5, 0.5). Up in the world is
        -y: the cameras' common up. The median depth of a point in the photos that see it is 1.

    Args:
        folder: at least 3 photos of one scene. Of those of a rarer shape the middle is taken if their Exif says a focal
            length, else they are left out. Folders in it are not looked into. Or a video, or a folder with one and
            without photos.
        out: the folder for the results, created if it does not exist.
        masks: the folder of their masks, white where a photo is kept; None: `masks` in `folder`, if there is one.
            What is black is not matched, and `out` gets the masks in `masks`.
        seed: of the solvers. The same photos and seed give the same files, but for the times in photos.json.
        frames: the number of frames that are taken from a video; see :func:`kgs.app.sfm.video.take_frames`.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.
        say: called with each line for the user.

    Returns:
        The content of photos.json: "photos" by file name, "left_out" (those without cameras, and why), "matches" of
        each pair, "size" (width, height), "photo_size" (that of the smallest photo before it was reduced), "focal_px",
        "focal_rise" (by what share squared errors grow if focal lengths are a quarter off; None if they were held at
        those of the Exif), "radial_distortion", "points", "reprojection_error_px", "agreement_degrees", "gates",
        "seconds" and others; "reused": whether a former run wrote it; and "folder": where the scene is.

    Raises:
        DataError: the folder holds no photos, some cannot be read, or `out` cannot take the results.
        PhotosRefused: the photos do not fit together, or their cameras cannot be trusted; the message says what to do,
            with the number of matches of each pair.
        ModuleNotFoundError: pycolmap is not installed (extra `sfm`).
        OSError: a result cannot be written.
    """
    with Results.open(Path(out), "photos", resume=False) as results:
        masks = None if masks is None else Path(masks)
        return pose(Source.unposed(Path(folder)), results, seed=seed, masks=masks, frames=frames, bar=bar, say=say)


def pose(
    source: Source,
    results: Results,
    *,
    seed: int,
    masks: Path | None,
    frames: int | None,
    for_fit: bool = False,
    bar: ProgressBar = each,
    say: Callable[[str], None] = say,
) -> dict[str, Any]:
    """As :func:`pose_photos`, in a folder that is open.

    New files for a fit are in `results.work` until it is done: a former one in the folder belongs to former cameras.
    """
    if source.video is not None:
        return _pose_video(source.video, results, frames, seed=seed, masks=masks, for_fit=for_fit, bar=bar, say=say)
    if source.path.resolve().is_relative_to(results.out.resolve()):
        raise DataError(results.out, "", "another folder than that of the photos", advice="choose another folder")
    mask_files = find_masks(source.photos, source.path, masks)
    for note in notes_on(source.path, source.photos, mask_files):
        say(note)
    opened = open_photos(source.photos, mask_files)
    inputs = {
        "settings": SETTINGS,
        "seed": seed,
        "sha256": {photo.name: photo.sha256 for photo in opened},
        "masks_sha256": {photo.name: sha256(photo.mask.load()).hexdigest() for photo in opened if photo.mask},
    }
    for folder in (results.work, results.out) if for_fit else (results.out,):
        if (report := _reusable_report(folder, inputs)) is not None:
            say(f"cameras: those in {printable(folder)} are of the same {len(opened)} photos and are used again")
            say_rejected(report.get("left_out", {}), say)
            return {**report, "reused": True, "folder": str(folder)}
    with _new_folder(results, for_fit) as new:
        report = inputs | find_cameras(opened, new, seed % 2**31, bar, say)
        write_json(new / REPORT, report)
    return {**report, "reused": False, "folder": str(results.work if for_fit else results.out)}


def _pose_video(video: Path, results: Results, frames: int | None, **options: Any) -> dict[str, Any]:
    """Find the cameras of a video's frames; errors about these name the video."""
    with TemporaryDirectory(prefix="kgs-") as name:
        folder = Path(name) / video.stem
        folder.mkdir()
        photos = take_frames(video, folder, frames, options["bar"], options["say"])
        try:
            return pose(Source(folder, photos=tuple(photos)), results, frames=None, **options)
        except DataError as error:
            path = video if Path(error.path) == folder else error.path
            raise type(error)(path, error.key, error.expected, error.got, advice=error.advice) from error


def _reusable_report(folder: Path, inputs: dict[str, Any]) -> dict[str, Any] | None:
    """The report of a former run with the same inputs, whose files are there."""
    try:
        report = read_json(folder / REPORT)
    except DataError:
        return None
    if any(report.get(key, {}) != inputs[key] for key in inputs):
        return None
    images = [photo["image"] for photo in report["photos"].values()]
    names = [f"{IMAGES}/{image}" for image in images] + [f"{MODEL}/{name}.bin" for name in _MODEL_FILES]
    names += [f"{MASKS}/{image}.png" for image in images] if inputs["masks_sha256"] else []
    return report if all((folder / name).is_file() for name in names) else None


@contextmanager
def _new_folder(results: Results, for_fit: bool) -> Iterator[Path]:
    """The folder for new files: that of a new fit, which nothing remains in after an error, or one to be published."""
    if not for_fit:
        with results.stage() as new:
            yield new
        return
    if has_fit(results.work):
        raise DataError(results.work, "", "no fit", "one of other photos that is not done", advice="remove this folder")
    results.begin()
    results.discard("photos")
    results.work.mkdir(exist_ok=True)
    try:
        yield results.work
    except BaseException:
        results.discard("photos")
        raise


def find_cameras(
    opened: list[OpenPhoto], new: Path, seed: int, bar: ProgressBar, say: Callable[[str], None]
) -> dict[str, Any]:
    """The report on the cameras of photos, whose `images`, `masks` and `sparse/0` are written to the folder `new`.

    Raises:
        PhotosRefused: the photos do not fit together, or their cameras cannot be trusted.
    """
    seconds, lap = _clock()
    unlike = unlike_others(opened)
    say_rejected(unlike, say)
    opened = [photo for photo in opened if photo.name not in unlike]
    png = png_names([photo.name for photo in opened])
    names = {image: name for name, image in png.items()}
    work = new / "work"
    work.mkdir(parents=True)
    with _one_thread(), report_full_disk(new):
        photos = read_photos(opened, bar)
        unsharp = [photo.name for photo in blurred(photos)]
        _say_notes(opened, photos, unsharp, say)
        folders = _write_photos(new, [photo.upright() for photo in photos], list(names))
        turned = {photo.name for photo in photos if photo.is_turned}
        if turned:
            folders = _write_photos(work, photos, list(names))
        lap("photos")
        found = accepted_cameras(photos, *folders, work, names, seed, bar, lap, say)
        for name in found.rejected:
            (new / IMAGES / png[name]).unlink()
            (new / MASKS / f"{png[name]}.png").unlink(missing_ok=True)
        if found.held:
            focals = " and ".join(f"{focal:.0f}" for focal in found.held)
            say(f"the photos do not tell the focal length; the Exif says {focals} pixels, and that is taken")
        cameras = upright(found.cameras, turned, names)
        level_and_scale(cameras)
        write_model(new / MODEL, cameras, new / IMAGES)
        shutil.rmtree(work)
        lap("files")
    placed = [photo for photo in photos if photo.name not in found.rejected]
    report = _report(found, cameras, placed)
    points, error = report["points"], report["reprojection_error_px"]
    say(f"cameras: {len(placed)} photos placed, {points} points, {error:.2f} pixels off")
    return {
        **report,
        "photo_size": list(min(photo.size for photo in opened)),
        "photos": {
            photo.name: {
                "image": png[photo.name],
                "points": cameras.points[photo.name],
                "blurred": photo.name in unsharp,
                "focal_px": cameras.focals[photo.name],
                "exif_focal_35mm": photo.exif.focal_35mm,
            }
            for photo in placed
        },
        "left_out": unlike | found.rejected,
        "seconds": seconds,
        "versions": {**versions(), "pycolmap": version("pycolmap")},
    }


def _say_notes(opened: list[OpenPhoto], photos: list[Photo], unsharp: list[str], say: Callable[[str], None]) -> None:
    for photo in photos:
        if photo.is_cut:
            say(f"{photo.name}: only its middle is taken, because it has another shape than most photos")
    for note in color_notes([photo.image for photo in opened]):
        say(note)
    if odd := [photo.name for photo in opened if photo.has_odd_focal]:
        say(f"a focal length in the Exif that no lens has is passed over: {listed(odd)}")
    if unsharp:
        say(f"blurred beside the others: {', '.join(unsharp)}; if the fit shows it, take them again")


def _write_photos(folder: Path, photos: list[Photo], names: list[str]) -> tuple[Path, Path]:
    """The folders of photos and of their masks, which are written. The second one exists if there are masks."""
    (folder / IMAGES).mkdir()
    write_images(folder / IMAGES, photos, names)
    write_masks(folder / MASKS, photos, names)
    return folder / IMAGES, folder / MASKS


def _report(found: Accepted, cameras: Cameras, photos: list[Photo]) -> dict[str, Any]:
    """What the report says about the cameras and the lens of most photos."""
    scene = cameras.reconstruction
    usual = [photo for photo in photos if cameras.focals[photo.name] == cameras.focal]
    lens = next(lens for lens in scene.cameras.values() if lens.focal_length == cameras.focal)
    width, height = photos[0].size
    return {
        "size": [width, height],
        "focal_px": cameras.focal,
        "focal_35mm": cameras.focal * FILM_DIAGONAL / float((width**2 + height**2) ** 0.5),
        "exif_focal_px": exif_focal(usual),
        "focal_rise": None if found.held else cameras.focal_rise,
        "radial_distortion": float(lens.params[3]),
        "matches": [[*pair, count] for pair, count in found.pairs.items()],
        "points": scene.num_points3D(),
        "reprojection_error_px": float(scene.compute_mean_reprojection_error()),
        "solver": found.solver,
        "agreement_degrees": found.degrees,
        "gates": {
            "focal_over_longer_side": list(FOCAL_RANGE),
            "min_points_of_a_photo": MIN_POINTS,
            "max_degrees": MAX_DEGREES,
            "max_focal_ratio": MAX_RATIO,
            "min_focal_rise": MIN_RISE,
            "passed": True,
        },
    }


def _clock() -> tuple[dict[str, float], Callable[[str], None]]:
    """The seconds of each part, and a function that is called with a part's name at its end."""
    seconds = dict[str, float]()
    last = time.perf_counter()

    def lap(part: str) -> None:
        nonlocal last
        now = time.perf_counter()
        seconds[part] = round(now - last, 2)
        last = now

    return seconds, lap


@contextmanager
def report_full_disk(folder: Path) -> Iterator[None]:
    """Turn a RuntimeError of pycolmap into an OSError if the disk is full, which pycolmap does not say."""
    try:
        yield
    except RuntimeError:
        check_space(folder)
        raise


@contextmanager
def _one_thread() -> Iterator[None]:
    """Run torch and OpenCV on one thread: their rounding depends on the number of threads."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with torch_on_one_thread():
            yield
    finally:
        cv2.setNumThreads(before)
