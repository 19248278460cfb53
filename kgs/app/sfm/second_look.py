"""More tries of a solver that failed, before photos are left out.

A mapper goes wrong with the first two photos that it takes: all others follow from them, and a model that collapses to
a few points is the end of its run. So the solver begins again, with other first pairs and other seeds. Photos that are
still missing are tried once more beside the other solver's cameras of the rest: points are computed from the solver's
own matches, the photo is registered by these points alone, and all cameras are adjusted to them.

A try is judged by what the solver itself sees: how many photos with enough points, then how many points. It is never
judged by how well it agrees with the other solver: of many tries one would agree by chance.
"""

from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path

from .gates import MIN_POINTS
from .map import Cameras, solve, verified

_MIN_TRIES = 2  # with other first pairs
_MAX_TRIES = 4
_REGISTRATIONS = 48  # of photos in all tries together, if that leaves as many tries: each registers all photos


def look_again(
    database: Path,
    images: Path,
    work: Path,
    seed: int,
    names: Mapping[str, str],
    focals: Sequence[float],
    found: Cameras | None,
    other: Cameras | None,
    doubtful: Set[str],
) -> Cameras | None:
    """The best of what a solver found and of its further tries, which end as soon as all photos are registered well.

    If it had registered all photos well, and the other solver differs, all tries are made.

    Args:
        database: as the other arguments up to `focals`, see :func:`kgs.app.sfm.map.solve`.
        images: the folder of the photos.
        work: a folder for what the mapper writes.
        seed: of the first look.
        names: the names of the photos to register, by those of the images in the database.
        focals: the focal length of each lens in pixels if they are known; (): they are adjusted.
        found: what the solver found at the first look.
        other: what the other solver found.
        doubtful: the photos that are to be registered again.
    """
    photos = list(names.values())
    best = found
    all_registered = len(seen_well(found, photos)) == len(photos)
    tries = min(_MAX_TRIES, max(_MIN_TRIES, _REGISTRATIONS // len(photos)))
    for number, pair in enumerate(_first_pairs(database, names, doubtful)[:tries], 1):
        min_registered = min(len(seen_well(best, photos)) + 1, len(photos))
        cameras = solve(
            database, images, work, seed + number, names, focals, first_pair=pair, min_registered=min_registered
        )
        best = _better(best, cameras, photos)
        if not all_registered and len(seen_well(best, photos)) == len(photos):
            return best
    registered = (seen_well(best, photos) & seen_well(other, photos)) - doubtful
    if other is not None and len(registered) >= 2:
        start = other._replace(rotations={name: other.rotations[name] for name in registered})
        cameras = solve(database, images, work, seed, names, focals, start=start, min_registered=len(registered) + 1)
        best = _better(best, cameras, photos)
    return best


def _first_pairs(database: Path, names: Mapping[str, str], doubtful: Set[str]) -> list[tuple[str, str]]:
    """Pairs of images with one of a doubtful photo at least, those with most verified matches first."""
    pairs = verified(database, {image: image for image in names})
    own = [pair for pair in pairs if pairs[pair] and not doubtful.isdisjoint(names[image] for image in pair)]
    return sorted(own, key=lambda pair: -pairs[pair])


def seen_well(cameras: Cameras | None, names: Iterable[str]) -> set[str]:
    """Which of these photos a solver registered so that they see enough points."""
    points = cameras.points if cameras else {}
    return {name for name in names if points.get(name, 0) >= MIN_POINTS}


def _better(one: Cameras | None, other: Cameras | None, photos: Sequence[str]) -> Cameras | None:
    """Those with more photos that see enough points; of as many, those with more points; the first of equals."""

    def merit(cameras: Cameras | None) -> tuple[int, int]:
        return len(seen_well(cameras, photos)), sum(cameras.points.values()) if cameras else -1

    return max(one, other, key=merit)
