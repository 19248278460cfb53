"""From photos to cameras that two solvers agree on, in a folder, and what is said of them in the report."""

import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import torch

from kgs.errors import DataError
from kgs.io.console import Stage
from kgs.io.outputs import png_names
from kgs.machine import versions

from .exif import FILM_DIAGONAL
from .gates import (
    FEWEST_POINTS,
    FOCAL_RANGE,
    LEAST_RISE,
    MOST_DEGREES,
    MOST_RATIO,
    Pairs,
    disagreement,
    faint_focal,
    objections,
    refusal,
    unfit,
    unlike_focals,
    untold,
)
from .mapping import Cameras, lens_found, looks, quiet_pycolmap, solve, verify, write_own_matches
from .matching import exif_focal, lens_of, write_matches
from .read import Photo, blurred, read_photos
from .write import IMAGES, MODEL, level_and_scale, write_images, write_model

SOLVERS = ("SIFT of OpenCV, AdaLAM of Kornia, COLMAP's mapper", "SIFT and matches of COLMAP, COLMAP's mapper")


def find_cameras(paths: list[Path], new: Path, seed: int, stage: Stage, say: Callable[[str], None]) -> dict[str, Any]:
    """Write `images` and `sparse/0` of photos to the folder `new`; returns the report.

    Raises:
        DataError: the photos do not fit together, or their cameras cannot be believed.
    """
    seconds, lap = dict[str, float](), _clock()
    folder, names, work, images = paths[0].parent, [path.name for path in paths], new / "work", new / IMAGES
    for path in (images, work):
        path.mkdir(parents=True)
    with _one_thread():
        photos = read_photos(paths, stage)
        unsharp = [photo.path.name for photo in blurred(photos)]
        if unsharp:
            say(f"blurred beside the others: {', '.join(unsharp)}; if the fit shows it, take them again")
        png = png_names(names)
        write_images(images, photos, list(png.values()))
        seconds["photos"] = lap()
        first, second, known = work / "first.db", work / "second.db", {image: name for name, image in png.items()}
        with quiet_pycolmap(), ThreadPoolExecutor(1) as beside:
            own = beside.submit(write_own_matches, second, images, list(png.values()), lens_of(photos), seed)
            write_matches(first, photos, list(png.values()), stage)
            pairs = verify(first, seed, known)
            seconds["matches"] = lap()
            if against := unfit(names, pairs, looks(first, known)):
                raise DataError(folder, "", against)
            other = beside.submit(lambda: (own.result(), solve(second, images, work / "second", seed, known))[1])
            found = [solve(first, images, work / "first", seed, known)]
            seconds["cameras"] = lap()
            found.append(other.result())
        placed = [cameras for cameras in found if cameras]
        held = exif_focal(photos) if placed and (faint_focal(placed) or unlike_focals(placed)) else None
        if held:
            say(f"the photos do not tell the focal length; the Exif says {held:.0f} pixels, and that is taken")
            found = [solve(matched, images, work / "held", seed, known, held) for matched in (first, second)]
        seconds["second solver"] = lap()
        chosen, degrees = judge(folder, found, names, max(photos[0].size), pairs)
        level_and_scale(chosen)
        write_model(new / MODEL, chosen, images)
        shutil.rmtree(work)
        seconds["files"] = lap()
    error = float(chosen.reconstruction.compute_mean_reprojection_error())
    say(f"cameras: {len(photos)} photos placed, {chosen.reconstruction.num_points3D()} points, {error:.2f} pixels off")
    return {
        **_lens(chosen, photos),
        "focal_rise": None if held else chosen.focal_rise,
        "photos": {
            photo.path.name: {
                "image": png[photo.path.name],
                "points": chosen.points[photo.path.name],
                "blurred": photo.path.name in unsharp,
                "exif_focal_35mm": photo.exif.focal_35mm,
            }
            for photo in photos
        },
        "matches": [[*pair, count] for pair, count in pairs.items()],
        "points": chosen.reconstruction.num_points3D(),
        "reprojection_error_px": error,
        "solver": SOLVERS[found.index(chosen)],
        "agreement_degrees": degrees,
        "gates": {
            "focal_over_longer_side": list(FOCAL_RANGE),
            "least_points_of_a_photo": FEWEST_POINTS,
            "most_degrees": MOST_DEGREES,
            "most_focal_ratio": MOST_RATIO,
            "least_focal_rise": LEAST_RISE,
            "passed": True,
        },
        "seconds": seconds,
        "versions": versions() | {"pycolmap": version("pycolmap")},
    }


def judge(
    folder: Path, found: list[Cameras | None], names: list[str], longest: int, pairs: Pairs
) -> tuple[Cameras, float]:
    """The cameras that pass the gates, and how far the two solvers are apart in degrees; a DataError if none do.

    If both pass, those whose worst photo sees more points are taken.
    """
    against = [objections(cameras, names, longest) for cameras in found]
    good = [cameras for cameras, reasons in zip(found, against, strict=True) if cameras and not reasons]
    if not good:
        raise DataError(folder, "", refusal(against[0], names, pairs))
    for cameras in found:  # what one of them did not place nothing confirms
        if missing := [name for name in names if cameras is None or name not in cameras.points]:
            reason = f"of two solvers one could not place {', '.join(missing)}, so that nothing confirms the other"
            raise DataError(folder, "", refusal([reason], names, pairs))
    both = [cameras for cameras in found if cameras]
    if doubt := faint_focal(both):
        raise DataError(folder, "", untold(doubt, names, pairs))
    degrees, pair = disagreement(*both)
    if degrees > MOST_DEGREES:
        reason = (
            f"two solvers are {degrees:.3g} degrees apart for {' and '.join(pair)}, at most {MOST_DEGREES:g} are right"
        )
        raise DataError(folder, "", refusal([reason], names, pairs))
    if doubt := unlike_focals(both):
        raise DataError(folder, "", untold(doubt, names, pairs))
    sure = [cameras for cameras in good if cameras.focal_rise >= LEAST_RISE] or good
    return max(sure, key=lambda cameras: min(cameras.points.values())), degrees


def _lens(cameras: Cameras, photos: list[Photo]) -> dict[str, Any]:
    """What the report says of size and lens."""
    width, height = photos[0].size
    film = cameras.focal * FILM_DIAGONAL / float((width**2 + height**2) ** 0.5)
    return {
        "size": [width, height],
        "focal_px": cameras.focal,
        "focal_35mm": film,
        "exif_focal_px": exif_focal(photos),
        "radial_distortion": float(lens_found(cameras.reconstruction).params[3]),
    }


def _clock() -> Callable[[], float]:
    """A function that gives the seconds since its last call."""
    last = time.perf_counter()

    def lap() -> float:
        nonlocal last
        before, last = last, time.perf_counter()
        return round(last - before, 2)

    return lap


@contextmanager
def _one_thread() -> Iterator[None]:
    """One thread for torch and OpenCV: sums of several are rounded in another order."""
    threads, cores = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        cv2.setNumThreads(cores)
