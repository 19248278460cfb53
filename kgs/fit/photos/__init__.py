"""Cameras from bare photos: what a phone wrote goes in, a scene that kgs and other programs read comes out.

Two solvers have to agree, and gates refuse what cannot be believed: see :mod:`kgs.fit.photos.gates`.
"""

import shutil
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

from kgs.io.console import Stage, say, silent
from kgs.io.json_files import read_json
from kgs.io.outputs import start_folder
from kgs.io.results_folder import locked

from .find import find_photos
from .mapping import quiet_pycolmap
from .pose import find_cameras
from .read import hash_photos
from .write import REPORT, UNFINISHED, WAITING, check_place, end_move, is_kept, is_whole, publish

__all__ = ["pose_photos"]

SETTINGS = 3  # grows with every change after which the same photos give other files


def pose_photos(
    folder: str | PathLike[str],
    out: str | PathLike[str],
    *,
    seed: int = 0,
    wait: bool = False,
    stage: Stage = silent,
    say: Callable[[str], None] = say,
) -> dict[str, Any]:
    """Find the cameras of bare photos, and write a scene that `kgs.datasets.load_scene` reads.

    The folder `out` gets `images` (upright PNGs of one size, at most 1600 pixels long, without metadata), `sparse/0`
    (COLMAP's binary model: one SIMPLE_RADIAL lens, poses, points with tracks) and `photos.json` (the report). If the
    photos are those of a former run, what is there is used again.

    Convention:
        COLMAP's: world-to-camera poses with OpenCV axes, the first pixel's centre at (0.5, 0.5). Up in the world is
        -y: the cameras' common up. The median depth of a point in the photos that see it is 1.

    Args:
        folder: at least 3 photos of one scene, by one lens. Folders in it are not looked into.
        out: the folder for the results, made if it is not there.
        seed: of what the solvers draw. The same photos and seed give the same files, but for the times in photos.json.
        wait: leave new files in `out/finished-photos` where `out` holds a fit, which belongs to the former cameras.
        stage: shows how far each part is, as `kgs.io.console.each` does.
        say: where lines for the user go.

    Returns:
        What photos.json holds: "photos" by file name, "matches" of each pair, "size" (width, height), "focal_px",
        "focal_rise" (by what share squared errors grow where the focal length is a quarter off; None where that of the
        Exif was held), "radial_distortion", "points", "reprojection_error_px", "agreement_degrees", "gates", "seconds"
        and others; "reused": whether it is a former run's; and "folder": where the scene is.

    Raises:
        DataError: the folder holds no photos that fit together, or their cameras cannot be believed; the message says
            what to do, with the number of matches of each pair.
        ModuleNotFoundError: pycolmap is not installed (extra `sfm`).
        OSError: a result cannot be written.
    """
    folder, out = Path(folder), Path(out)
    with quiet_pycolmap():  # a missing package is told before any work
        pass
    paths = find_photos(folder)
    check_place(out, folder)
    hashes = hash_photos(paths)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        waiting, same = out / WAITING, {"settings": SETTINGS, "seed": seed, "sha256": hashes}
        if not (wait and is_whole(waiting)):
            end_move(out)
        place = next((place for place in (waiting, out) if is_kept(place, same)), None)
        if place is not None:
            say(f"cameras: those in {place} are of the same {len(paths)} photos and are used again")
        if place == out:
            shutil.rmtree(waiting, ignore_errors=True)
        if place is None:
            new = out / UNFINISHED
            start_folder(new)
            try:
                publish(out, same | find_cameras(paths, new, seed % 2**31, stage, say))
            finally:
                shutil.rmtree(new, ignore_errors=True)
        if not (wait and (out / "splat.ply").exists()):
            end_move(out)
        found = waiting if is_whole(waiting) else out
        return read_json(found / REPORT) | {"reused": place is not None, "folder": str(found)}
