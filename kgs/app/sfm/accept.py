"""Cameras that can be trusted, of as many photos as possible.

A low reprojection error proves nothing: a few matches fit wrong cameras as well. So two solvers, which use other
keypoints, each find the cameras. *Consensus*: both register a photo, and agree about its rotation and its lens.
*Retry*: before a photo is rejected, the solvers that failed about it try again. *Rejected photos*: those that show
another place, or the same as another photo from the same place, those without consensus or with few points, and the
smaller of two groups between which something was moved; at least three remain. *Acceptance checks*: of the others the
focal length has to be in the range of real lenses, and determined by the photos or their Exif; each photo has to see
many points; and the solvers have to agree. Else all photos are refused, and the user is told what to photograph next.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple, NoReturn

import torch

from kgs._support.errors import PhotosRefused
from kgs._support.progress import ProgressBar
from kgs.geometry.rigs import degrees_between

from .find import MIN_PHOTOS
from .map import Cameras, Solver
from .match import colmap_matching, lenses_of, write_matches
from .moved import moved_photos
from .pairs import (
    FEWER,
    MIN_MATCHES,
    Pairs,
    gap,
    pair_geometry,
    table,
    verified_matches,
    weakest_link,
    went_forward,
    what_would_help,
    why_no_cameras,
    without_overlap,
)
from .pycolmap_processes import PycolmapProcesses
from .read import Photo

SOLVERS = ("SIFT of OpenCV, AdaLAM of Kornia, COLMAP's mapper", "SIFT and matches of COLMAP, COLMAP's mapper")
FOCAL_RANGE = 0.4, 3.0  # of the longer side
MIN_POINTS = 50  # that each photo sees
MAX_DEGREES = 2.0  # between the two solvers' rotations of a pair
MAX_RATIO = 1.15  # of their focal lengths
MIN_RISE = 0.03  # relative growth of the squared errors if the focal length is a quarter off
_MIN_TRIES = 2  # of a retry, with other first pairs
_MAX_TRIES = 4
_REGISTRATIONS = 48  # of photos in all tries together, if that leaves as many tries: each registers all photos
_UNTOLD = "the photos do not tell the focal length, and their Exif does not say it"
_FORWARD = (
    "The camera moved along its view: what lies ahead hardly moves between such photos, which hides its depth.\n"
    f"What helps: step sideways, not forward, so that neighbours are 3 to 20 degrees apart.\n{FEWER}"
)
_APART = (
    "As a rule they are too close together.\n"
    "What helps: larger steps to the side or up, so that neighbours are 3 to 20 degrees apart.\n"
    "Or the photos as the camera wrote them: messengers and many editors drop Exif"
)

Solutions = tuple[Cameras, Cameras]  # what the two solvers found


class Accepted(NamedTuple):
    """The cameras that were accepted."""

    cameras: Cameras
    solver: str  # whose they are
    degrees: float  # the largest difference between two solvers
    held: list[float]  # focal lengths of the Exif, in pixels, one a lens; [] where the photos tell them
    pairs: Pairs  # verified matches of each pair of all photos
    rejected: dict[str, str]  # photos without cameras, and why


def accepted_cameras(
    photos: list[Photo],  # all of one size
    images: Path,  # the folder where they are as PNGs
    masks: Path,  # that of their masks, which exists if there are any
    work: Path,  # a folder for what the solvers write
    names: Mapping[str, str],  # of the photos by those of the PNGs, in the order of `photos`
    seed: int,
    bar: ProgressBar,
    lap: Callable[[str], None],  # called with the name of each part at its end
    say: Callable[[str], None],
) -> Accepted:
    """The cameras of as many photos as two solvers agree on; PhotosRefused if these are not even three."""
    folder = photos[0].path.parent
    size = photos[0].size
    lenses = lenses_of(photos)
    first, second = (Solver(work / f"{name}.db", images, work / name, seed) for name in ("first", "second"))
    with ThreadPoolExecutor(1) as executor, PycolmapProcesses() as processes:
        matching = colmap_matching(photos, lenses, images, masks, work, list(names))
        second_matches = executor.submit(processes.run, "write_colmap_matches", second.database, seed=seed, **matching)
        write_matches(first.database, photos, list(names), lenses, bar)
        processes.run("verify", first.database, seed=seed)
        matches = {(names[a], names[b]): found for (a, b), found in verified_matches(first.database).items()}
        pairs = {pair: len(found) for pair, (found, _) in matches.items()}
        lap("matches")
        geometries = {pair: pair_geometry(*matches[pair], size) for pair in pairs if pairs[pair] >= MIN_MATCHES}
        rejected = without_overlap(list(names.values()), pairs, geometries)
        geometries = {pair: geometry for pair, geometry in geometries.items() if rejected.keys().isdisjoint(pair)}
        kept = {image: name for image, name in names.items() if name not in rejected}
        if reason := why_no_cameras(list(kept.values()), pairs, geometries):
            raise PhotosRefused(folder, "", "photos whose cameras can be found", advice=reason)
        are_known = all(lens.has_prior_focal_length for lens in lenses)
        known = [lens.focal_length for lens in lenses] if are_known else []
        consensus = Consensus((first, second), second_matches, executor, known, pairs)
        solutions, held = consensus.solve(kept)
        while more := without_cameras(solutions, list(kept.values()), pairs) or moved_between(solutions, kept):
            rejected |= more
            kept = {image: name for image, name in kept.items() if name not in rejected}
            solutions, held = consensus.solve(kept)
        lap("cameras")
    say_rejected(rejected, say)
    forward = went_forward(geometries)
    which, degrees = check(folder, solutions, list(kept.values()), max(size), pairs, forward=forward)
    return Accepted(solutions[which], SOLVERS[which], degrees, held, pairs, rejected)


def say_rejected(rejected: Mapping[str, str], say: Callable[[str], None]) -> None:
    """Say which photos are left out, and why, a line each."""
    for name, why in rejected.items():
        say(f"left out: {name}: {why}")


@dataclass(frozen=True)
class Consensus:
    """Two solvers of the same photos, at work at the same time: the second one in the executor's only thread."""

    solvers: tuple[Solver, Solver]
    second_matches: "Future[None]"
    executor: ThreadPoolExecutor
    exif_focals: list[float]  # of each lens, in pixels; [] where one is not known
    pairs: Pairs

    def solve(self, names: Mapping[str, str]) -> tuple[Solutions, list[float]]:
        """What each solver finds, and the focal lengths of the Exif where only these tell them, else []."""
        free = self._both(lambda i: self._solve(i, names))
        solutions, held = self._hold_focals_in_doubt(free, names)
        if not doubtful(solutions, list(names.values()), self.pairs):
            return solutions, held
        again = self._retry(free, names)
        if any(new is not old for new, old in zip(again, free, strict=True)):
            solutions, held = self._hold_focals_in_doubt(again, names)
        return (self._retry(solutions, names, held) if held else solutions), held

    def _hold_focals_in_doubt(self, solutions: Solutions, names: Mapping[str, str]) -> tuple[Solutions, list[float]]:
        solved = [cameras for cameras in solutions if cameras.points]
        if not self.exif_focals or not solved or not (focal_doubt(solved) or focal_difference(solved)):
            return solutions, []
        return self._both(lambda i: self._solve(i, names, self.exif_focals)), self.exif_focals

    def _retry(self, solutions: Solutions, names: Mapping[str, str], focals: Sequence[float] = ()) -> Solutions:
        """The solutions after a retry of the solvers that failed about a photo, or of both if they differ."""
        photos = doubtful(solutions, list(names.values()), self.pairs)
        well = [seen_well(cameras, photos) for cameras in solutions]
        is_disputed = bool(well[0] & well[1])

        def again(i: int) -> Cameras:
            if well[i] == photos and not is_disputed:
                return solutions[i]
            return retry(self.solvers[i], names, focals, solutions[i], solutions[1 - i], photos)

        return self._both(again)

    def _solve(self, i: int, names: Mapping[str, str], focals: Sequence[float] = ()) -> Cameras:
        if i == 1:
            self.second_matches.result()
        return self.solvers[i].solve(names, focals)

    def _both(self, solve: Callable[[int], Cameras]) -> Solutions:
        second = self.executor.submit(solve, 1)
        return solve(0), second.result()


def retry(
    solver: Solver,
    names: Mapping[str, str],
    focals: Sequence[float],  # as of `Solver.solve`
    found: Cameras,  # by this solver
    other: Cameras,  # by the other one
    photos: Set[str],  # to be registered again
) -> Cameras:
    """The best of what a solver found and of its further tries, which end as soon as all photos are registered well.

    A mapper goes wrong with the first two photos that it takes: all others follow from them. So it begins again, with
    other first pairs and other seeds. Photos that are still missing are tried once more beside the other solver's
    cameras of the rest: points are computed from the solver's own matches, the photo is registered by these points
    alone, and all cameras are adjusted to them. If the solver had registered all photos well, and the other one
    differs, all tries are made.

    A try is judged by what the solver itself sees: how many photos with enough points, then how many points. It is
    never judged by how well it agrees with the other solver: of many tries one would agree by chance.
    """
    best = found
    all_photos = set(names.values())
    is_whole = seen_well(found, all_photos) == all_photos
    tries = min(_MAX_TRIES, max(_MIN_TRIES, _REGISTRATIONS // len(names)))
    matches = {pair: len(first) for pair, (first, _) in verified_matches(solver.database).items() if len(first)}
    pairs = [pair for pair in matches if names.keys() >= {*pair} and not photos.isdisjoint(map(names.get, pair))]
    pairs.sort(key=lambda pair: -matches[pair])
    for attempt, pair in enumerate(pairs[:tries], 1):
        at_least = min(len(seen_well(best, all_photos)) + 1, len(names))
        again = solver.solve(names, focals, attempt=attempt, first_pair=pair, at_least=at_least)
        best = max(best, again, key=_merit)
        if not is_whole and seen_well(best, all_photos) == all_photos:
            return best
    registered = (seen_well(best, all_photos) & seen_well(other, all_photos)) - photos
    if len(registered) >= 2:
        start = other._replace(rotations={name: other.rotations[name] for name in registered})
        again = solver.solve(names, focals, start=start, at_least=len(registered) + 1)
        best = max(best, again, key=_merit)
    return best


def _merit(cameras: Cameras) -> tuple[int, int]:
    """How many photos see enough points, and how many points all see."""
    return len(seen_well(cameras, cameras.points)), sum(cameras.points.values())


def seen_well(cameras: Cameras, names: Iterable[str]) -> set[str]:
    """Which of these photos a solver registered so that they see enough points."""
    return {name for name in names if cameras.points.get(name, 0) >= MIN_POINTS}


def without_cameras(solutions: Solutions, names: Sequence[str], pairs: Pairs) -> dict[str, str]:
    """Photos whose cameras cannot be trusted while those of at least `MIN_PHOTOS` others can, and why."""
    # without photos that were registered badly the solvers may agree about the others
    left = _registered_badly(*solutions, names, pairs) or _disputed(*solutions, names)
    return left if len(names) - len(left) >= MIN_PHOTOS else {}


def moved_between(solutions: Solutions, names: Mapping[str, str]) -> dict[str, str]:
    """Photos that one flat thing alone joins to a larger group of at least `MIN_PHOTOS`, and why they are left out.

    Args:
        solutions: what the two solvers found.
        names: those of the photos, by those of their images.
    """
    found = [moved_photos(cameras.reconstruction) for cameras in solutions if cameras.points]
    images = next(filter(None, found), [])
    if len(names) - len(images) < MIN_PHOTOS:
        return {}
    why = "only one flat thing joins it to the other group of photos: was that moved, or is this another place?"
    return {names[image]: why for image in images}


def doubtful(solutions: Solutions, names: Sequence[str], pairs: Pairs) -> set[str]:
    """Photos whose cameras cannot be trusted, also where too few others remain."""
    left = _registered_badly(*solutions, names, pairs)
    return {*left, *_disputed(*solutions, [name for name in names if name not in left])}


def _registered_badly(first: Cameras, second: Cameras, names: Sequence[str], pairs: Pairs) -> dict[str, str]:
    """The photos that a solver failed to register, that see few points, or whose lens is disputed, and why."""
    left = dict[str, str]()
    registered = [name for name in names if name in first.points and name in second.points]

    def seen(found: Cameras) -> tuple[int, int]:
        return len(seen_well(found, registered)), min((found.points[name] for name in registered), default=0)

    better = max((first, second), key=seen)
    for name in names:
        advice = what_would_help(name, [other for other in names if other != name], pairs)
        if name not in registered:
            who = "only one" if name in first.points or name in second.points else "neither"
            left[name] = f"{who} of two solvers could place it{advice}"
        elif better.points[name] < MIN_POINTS:
            left[name] = f"only {better.points[name]} points are seen in it, fewer than {MIN_POINTS}{advice}"
        elif first.focals[name] != first.focal:  # another lens than that of most
            ratio = first.focals[name] / second.focals[name]
            if max(ratio, 1 / ratio) > MAX_RATIO:
                factor = f"{max(ratio, 1 / ratio):.3g}"
                left[name] = f"two solvers differ by a factor of {factor} about the focal length of its lens"
    return left


def _disputed(first: Cameras, second: Cameras, names: Sequence[str]) -> dict[str, str]:
    """The photos about which solvers differ, one after the other: each time the one that most pairs are disputed with.

    About all pairs of the others they agree. Fewer than three of these may be left.
    """
    angles = {pair: angle_between(first, second, pair) for pair in combinations(names, 2)}
    left = dict[str, str]()
    while angles and max(angles.values()) > MAX_DEGREES:
        of_name = {name: [angle for pair, angle in angles.items() if name in pair] for name in names}
        worst = max(names, key=lambda name: (sum(angle > MAX_DEGREES for angle in of_name[name]), sum(of_name[name])))
        left[worst] = f"two solvers are {max(of_name[worst]):.3g} degrees apart about it"
        names = [name for name in names if name != worst]
        angles = {pair: angle for pair, angle in angles.items() if worst not in pair}
    return left


def angle_between(first: Cameras, second: Cameras, pair: tuple[str, str]) -> float:
    """The angle between two solvers' rotations from one camera to another, in degrees."""
    both = [cameras.rotations[pair[1]] @ cameras.rotations[pair[0]].T for cameras in (first, second)]
    return float(degrees_between(*map(torch.from_numpy, both)))


def largest_difference(first: Cameras, second: Cameras, names: Sequence[str]) -> tuple[float, tuple[str, str]]:
    """The largest angle between two solvers' rotations from one camera to another, in degrees, and that pair."""
    return max((angle_between(first, second, pair), pair) for pair in combinations(sorted(names), 2))


def check(
    folder: Path, solutions: Solutions, names: list[str], longest: int, pairs: Pairs, *, forward: bool = False
) -> tuple[int, float]:
    """The index of the cameras that pass the acceptance checks, and the solvers' largest difference in degrees.

    If both pass, it is that of those whose worst photo sees more points. If none does, PhotosRefused names the folder;
    where the camera moved along its view, it speaks of that.
    """

    def refuse(reason: str, advice: str) -> NoReturn:
        said = f"{reason}.\n{_FORWARD if forward else advice}.\n{table(names, pairs)}"
        raise PhotosRefused(folder, "", "photos whose cameras can be trusted", advice=said)

    missing = [name for name in names if any(name not in cameras.points for cameras in solutions)]
    registered = [name for name in names if name not in missing]
    between = gap(missing[0], registered, pairs) if missing and registered else weakest_link(names, pairs)
    beside = (
        f"What helps: photos from places between {' and '.join(between)}, with steps to the side or up.\n"
        "Neighbours share two thirds of the scene, which has texture; all with one lens, without zoom.\n"
        f"{FEWER}"
    )
    reasons = [objections(cameras, names, longest) for cameras in solutions]
    good = [i for i, objection in enumerate(reasons) if not objection]
    two_ways = "kgs finds the cameras in two ways, and"
    if not good:
        refuse("; ".join(reasons[0]), beside)
    if missing:
        refuse(f"{two_ways} only one could place {', '.join(missing)}, so that nothing confirms it", beside)
    if doubt := focal_doubt(solutions):
        refuse(doubt, _APART)
    degrees, pair = largest_difference(*solutions, names)
    if degrees > MAX_DEGREES:
        by = f"by {degrees:.3g} degrees; expected at most {MAX_DEGREES:g}"
        refuse(f"{two_ways} they disagree about {' and '.join(pair)} ({by})", beside)
    if doubt := focal_difference(solutions):
        refuse(doubt, _APART)
    sure = [i for i in good if solutions[i].focal_rise >= MIN_RISE] or good
    return max(sure, key=lambda i: min(solutions[i].points.values())), degrees


def objections(cameras: Cameras, names: Sequence[str], longest: int) -> list[str]:
    """The reasons to refuse one solver's cameras, a sentence each."""
    if not cameras.points:
        return ["no pair of photos gave a first guess of the cameras"]
    reasons = []
    if missing := [name for name in names if name not in cameras.points]:
        reasons.append(f"{len(missing)} of {len(names)} photos could not be placed: {', '.join(missing)}")
    limits = f"{FOCAL_RANGE[0]:g} to {FOCAL_RANGE[1]:g}"
    for ratio in sorted({focal / longest for focal in cameras.focals.values()}):
        if not FOCAL_RANGE[0] <= ratio <= FOCAL_RANGE[1]:
            came_out = f"the focal length came out at {ratio:.3g} times the longer side"
            reasons.append(f"{came_out}, where lenses have {limits}")
    if few := [f"{name} ({seen})" for name, seen in cameras.points.items() if seen < MIN_POINTS]:
        reasons.append(f"fewer than {MIN_POINTS} points are seen in {', '.join(few)}")
    return reasons


def focal_doubt(solutions: Sequence[Cameras]) -> str:
    """Why the focal length is in doubt after all solutions, or ""."""
    rise = max(0.0, *(cameras.focal_rise for cameras in solutions))
    if rise >= MIN_RISE:
        return ""
    return f"{_UNTOLD}: where it is a quarter off, squared errors grow by {rise:.1%}, less than {MIN_RISE:.0%}"


def focal_difference(solutions: Sequence[Cameras]) -> str:
    """How far the solvers' focal lengths are apart, if that is too far for one of the lenses, or ""."""
    registered = set[str].intersection(*(set(cameras.focals) for cameras in solutions))
    focals = [[cameras.focal for cameras in solutions]]
    focals += [[cameras.focals[name] for cameras in solutions] for name in registered]
    ratio = max(max(of_lens) / min(of_lens) for of_lens in focals)
    if ratio <= MAX_RATIO:
        return ""
    return f"{_UNTOLD}: those of two solvers differ by a factor of {ratio:.3g}, more than {MAX_RATIO:g}"
