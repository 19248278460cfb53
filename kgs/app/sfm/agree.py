"""Cameras that two solvers agree on: matches them, solves twice, leaves out unsuitable photos, and asks the gates."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from kgs._support.errors import PhotosRefused
from kgs._support.progress import ProgressBar

from .gates import Pairs, focal_difference, focal_doubt, is_forward, judge, why_no_cameras
from .leave_out import doubtful, without_cameras, without_overlap
from .map import Cameras, pair_geometries, quiet_pycolmap, solve, verified
from .match import exif_focals, lenses_of, write_matches
from .pycolmap_processes import PycolmapProcesses
from .read import Photo
from .second_look import look_again, seen_well
from .write import write_images

SOLVERS = ("SIFT of OpenCV, AdaLAM of Kornia, COLMAP's mapper", "SIFT and matches of COLMAP, COLMAP's mapper")


class Agreed(NamedTuple):
    """The cameras that passed the gates."""

    cameras: Cameras
    solver: str  # whose they are
    degrees: float  # the largest difference between two solvers
    held: list[float]  # focal lengths of the Exif, in pixels, one a lens; [] where the photos tell them
    pairs: Pairs  # verified matches of each pair of all photos
    left_out: dict[str, str]  # photos without cameras, and why


def agreed_cameras(
    photos: list[Photo],
    images: Path,
    masks: Path,
    work: Path,
    names: Mapping[str, str],
    seed: int,
    bar: ProgressBar,
    lap: Callable[[str], None],
    say: Callable[[str], None],
) -> Agreed:
    """The cameras of as many photos as two solvers agree on.

    Args:
        photos: the photos, all of one size.
        images: the folder where they are as PNGs.
        masks: the folder of their masks, which exists if there are any.
        work: a folder for what the solvers write.
        names: the names of the photos by those of the PNGs, in the order of `photos`.
        seed: of the solvers.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.
        lap: called with the name of each part at its end.
        say: called with each line for the user.

    Raises:
        PhotosRefused: the photos do not fit together, or not even three cameras can be trusted.
    """
    folder = photos[0].path.parent
    first = work / "first.db"
    second = work / "second.db"
    with quiet_pycolmap(), ThreadPoolExecutor(1) as executor, PycolmapProcesses() as processes:
        second_matches = executor.submit(
            processes.run,
            "write_colmap_matches",
            second,
            images=str(_without_alpha(photos, images, work, names)),
            lenses=_lenses(photos, list(names)),
            masks=str(masks) if masks.is_dir() else None,
            seed=seed,
        )
        write_matches(first, photos, list(names), bar)
        processes.run("verify", first, seed=seed)
        pairs = verified(first, names)
        lap("matches")
        geometries = pair_geometries(first, names)
        left_out = without_overlap(list(names.values()), pairs, geometries)
        kept = {image: name for image, name in names.items() if name not in left_out}
        geometries = {pair: geometry for pair, geometry in geometries.items() if left_out.keys().isdisjoint(pair)}
        if reason := why_no_cameras(list(kept.values()), pairs, geometries):
            raise PhotosRefused(folder, "", "photos whose cameras can be found", advice=reason)
        solvers = _Solvers((first, second), second_matches, images, work, seed, exif_focals(photos), executor, pairs)
        solutions, held = solvers.solve(kept)
        while untrusted := without_cameras(solutions, list(kept.values()), pairs):
            left_out |= untrusted
            kept = {image: name for image, name in kept.items() if name not in left_out}
            solutions, held = solvers.solve(kept)
        lap("cameras")
    say_left_out(left_out, say)
    longest = max(photos[0].size)
    forward = is_forward(geometries)
    which, degrees = judge(folder, solutions, list(kept.values()), longest, pairs, forward=forward)
    cameras = solutions[which]
    assert cameras is not None  # it passed
    return Agreed(cameras, SOLVERS[which], degrees, held, pairs, left_out)


def say_left_out(left_out: Mapping[str, str], say: Callable[[str], None]) -> None:
    """Say which photos are left out, and why, a line each."""
    for name, why in left_out.items():
        say(f"left out: {name}: {why}")


@dataclass(frozen=True)
class _Solvers:
    """Two solvers with their matches; the second one works in the executor's only thread."""

    databases: tuple[Path, Path]
    second_matches: "Future[None]"
    images: Path
    work: Path
    seed: int
    exif_focals: list[float | None]  # of each lens
    executor: ThreadPoolExecutor
    pairs: Pairs

    def solve(self, names: Mapping[str, str]) -> tuple[list[Cameras | None], list[float]]:
        """What each solver finds, and the focal lengths of the Exif if the photos do not tell them, else [].

        Where photos would be left out, those that failed look again. `names` are those of the photos to register, by
        those of their images.
        """
        free = self._both(lambda solver: self._solve(solver, names))
        solutions, held = self._held_if_in_doubt(free, names)
        if not doubtful(solutions, list(names.values()), self.pairs):
            return solutions, held
        again = self._look_again(free, names)
        if any(new is not old for new, old in zip(again, free, strict=True)):
            solutions, held = self._held_if_in_doubt(again, names)
        return (self._look_again(solutions, names, held) if held else solutions), held

    def _held_if_in_doubt(
        self, solutions: list[Cameras | None], names: Mapping[str, str]
    ) -> tuple[list[Cameras | None], list[float]]:
        """The solutions, or those with the focal lengths of the Exif if these are known and the photos tell none."""
        solved = [cameras for cameras in solutions if cameras]
        known = [focal for focal in self.exif_focals if focal]
        is_known = len(known) == len(self.exif_focals)
        if not is_known or not solved or not (focal_doubt(solved) or focal_difference(solved)):
            return solutions, []
        return self._both(lambda solver: self._solve(solver, names, known)), known

    def _look_again(
        self, solutions: list[Cameras | None], names: Mapping[str, str], focals: Sequence[float] = ()
    ) -> list[Cameras | None]:
        """The solutions after a second look of the solvers that failed about a photo, or of both if they differ."""
        photos = doubtful(solutions, list(names.values()), self.pairs)
        well = [seen_well(cameras, photos) for cameras in solutions]
        is_disputed = bool(well[0] & well[1])

        def look(solver: int) -> Cameras | None:
            found = solutions[solver]
            if well[solver] == photos and not is_disputed:
                return found
            arguments = (self.databases[solver], self.images, self.work / f"again{solver}", self.seed)
            return look_again(*arguments, names, focals, found, solutions[1 - solver], photos)

        return self._both(look)

    def _both(self, solve: Callable[[int], Cameras | None]) -> list[Cameras | None]:
        """What a function finds for the first solver, and at the same time for the second."""
        second = self.executor.submit(solve, 1)
        return [solve(0), second.result()]

    def _solve(self, solver: int, names: Mapping[str, str], focals: Sequence[float] = ()) -> Cameras | None:
        if solver == 1:
            self.second_matches.result()
        return solve(self.databases[solver], self.images, self.work / f"mapper{solver}", self.seed, names, focals)


def _lenses(photos: list[Photo], images: list[str]) -> list[tuple[list[str], str | None]]:
    """The names of each lens's images, and its parameters where the Exif says its focal length."""
    return [
        (
            [image for photo, image in zip(photos, images, strict=True) if photo.lens == number],
            lens.params_to_string() if lens.has_prior_focal_length else None,
        )
        for number, lens in enumerate(lenses_of(photos))
    ]


def _without_alpha(photos: list[Photo], images: Path, work: Path, names: Mapping[str, str]) -> Path:
    """The folder of the photos over black: COLMAP would find keypoints in what alpha hides."""
    if all(photo.is_opaque for photo in photos):
        return images
    opaque = work / "opaque"
    opaque.mkdir()
    write_images(opaque, photos, list(names), opaque=True)
    return opaque
