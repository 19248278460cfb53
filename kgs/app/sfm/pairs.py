"""Pairs of photos: their verified matches, what these say about depth, and how they hold the photos together."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .colmap import pycolmap
from .find import MIN_PHOTOS
from .map import MAX_ERROR

MIN_MATCHES = 30  # verified matches of a pair that overlaps; of noise up to 27 were verified
_MIN_SHIFT = 1.0  # pixels; photos whose matches move less in the median were taken from one place
_PLANAR = 0.97  # share of matches that one homography explains; a scene with depth has a pair with a lower one
_ONE_WAY = 0.9  # share of the matches that move away from where a camera goes, or towards it
FEWER = "To fit only some of the photos, take the others out of the folder"

Pairs = Mapping[tuple[str, str], int]  # verified matches of each pair
Pixels = NDArray[np.floating]  # `(M, 2)`


class PairGeometry(NamedTuple):
    """What the matches of two photos say about depth."""

    shift: float  # median distance that they move between the photos, pixels
    planar: float  # share that one homography explains: 1 where the camera only turned, or saw one plane
    forward: bool = False  # whether each photo shows where the other was taken: the camera moved along its view


def verified_matches(database: Path) -> dict[tuple[str, str], tuple[Pixels, Pixels]]:
    """Where the verified matches of each pair are in its two images, by the names that these have in a database."""
    matches = {}
    with pycolmap.Database.open(database) as file:
        images = {image.image_id: image.name for image in file.read_all_images()}
        keypoints = {i: file.read_keypoints(i)[:, :2] for i in images}
        for i, j in combinations(sorted(images), 2):
            rows = np.zeros((0, 2), np.int64)
            if file.exists_two_view_geometry(i, j):
                rows = np.asarray(file.read_two_view_geometry(i, j).inlier_matches, np.int64)
            matches[images[i], images[j]] = keypoints[i][rows[:, 0]], keypoints[j][rows[:, 1]]
    return matches


def pair_geometry(first: Pixels, second: Pixels, size: tuple[int, int]) -> PairGeometry:
    """What the matches of two photos of this width and height say about depth."""
    _, planar = cv2.findHomography(first, second, cv2.RANSAC, MAX_ERROR)
    shift = float(np.median(np.linalg.norm(first - second, axis=1)))
    return PairGeometry(shift, 0.0 if planar is None else float(np.mean(planar)), is_forward(first, second, size))


def is_forward(first: Pixels, second: Pixels, size: tuple[int, int]) -> bool:
    """Whether both photos show the centre of the other's camera, and nearly all matches move away from it.

    The centres are seen at the epipoles, of a matrix that few or wrong matches leave open: hence the second condition.
    """
    fundamental, _ = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, MAX_ERROR, 0.999)
    if fundamental is None or fundamental.shape != (3, 3):
        return False
    homogeneous = np.array([np.linalg.svd(matrix)[2][-1] for matrix in (fundamental, fundamental.T)])
    with np.errstate(divide="ignore", invalid="ignore"):
        epipoles = homogeneous[:, :2] / homogeneous[:, 2:]
    if not bool(((epipoles > 0) & (epipoles < size)).all()):
        return False
    away = np.linalg.norm(second - epipoles[1], axis=1) > np.linalg.norm(first - epipoles[0], axis=1)
    return bool(abs(away.mean() - 0.5) > _ONE_WAY - 0.5)


def without_overlap(
    names: Sequence[str], pairs: Pairs, geometries: Mapping[tuple[str, str], PairGeometry]
) -> dict[str, str]:
    """Photos that cannot help, by their matches alone, and why.

    The second of two photos from one place, and photos outside the largest group that overlapping pairs connect, if
    that is larger than any other. `geometries` are those of overlapping pairs.
    """
    left = {
        second: f"it shows the same from the same place as {first}"
        for (first, second), geometry in geometries.items()
        if geometry.shift < _MIN_SHIFT
    }
    groups = groups_of([name for name in names if name not in left], pairs)
    if len(groups) > 1 and len(groups[0]) > len(groups[1]):
        for name in (name for group in groups[1:] for name in group):
            maximum = max(count(pairs, name, other) for other in groups[0])
            said = (
                f"it has at most {maximum} matches with the others"
                if maximum
                else "it shows nothing that the others show"
            )
            left[name] = f"{said}{what_would_help(name, groups[0], pairs)}"
    return left if len(names) - len(left) >= MIN_PHOTOS else {}


def why_no_cameras(names: Sequence[str], pairs: Pairs, geometries: Mapping[tuple[str, str], PairGeometry]) -> str:
    """Why matches fail to give cameras, and what to photograph next, as the advice of an error, or ""."""
    if twins := [pair for pair, geometry in geometries.items() if geometry.shift < _MIN_SHIFT]:
        one, other = twins[0]
        return (
            f"{one} and {other} match at the same pixels.\n"
            "If they show the same from the same place, remove one of them.\n"
            "If they carry the same watermark, caption or frame, crop it from all photos"
        )
    groups = groups_of(names, pairs)
    if len(groups) == 1 and min(geometry.planar for geometry in geometries.values()) < _PLANAR:
        return ""
    if len(groups) == 1:
        reason = "in every pair one plane, or a camera that only turned on the spot, explains all matches"
        advice = "Take a step to the side or up between photos, and show things that are nearer and farther"
    elif len(groups[0]) == 1:
        reason = f"no two of the {len(names)} photos show enough of the same things"
        advice = "Take them again with a smaller step between neighbours: two thirds of a photo should be in the next"
    else:
        listed = "; ".join(f"{i}: {', '.join(group)}" for i, group in enumerate(groups, 1))
        reason = f"the photos fall into {len(groups)} groups that do not overlap ({listed})"
        between = f"take photos from places between {' and '.join(weakest_link(names, pairs))}"
        advice = f"If they show two scenes, keep one group in the folder; if they show one, {between}"
    return f"{reason}.\n{advice}.\n{FEWER}.\n{table(names, pairs)}"


def went_forward(geometries: Mapping[tuple[str, str], PairGeometry]) -> bool:
    """Whether the camera moved along its view in every pair that shows depth."""
    telling = [geometry for geometry in geometries.values() if geometry.planar < _PLANAR]
    return bool(telling) and all(geometry.forward for geometry in telling)


def count(pairs: Pairs, one: str, other: str) -> int:
    """The verified matches of two photos."""
    return pairs.get((one, other), pairs.get((other, one), 0))


def groups_of(names: Sequence[str], pairs: Pairs) -> list[list[str]]:
    """Groups of photos that overlapping pairs connect, the largest first, each in the order of `names`.

    `pairs` may have photos besides those in `names`.
    """
    groups = [{name} for name in names]
    for pair, matches in pairs.items():
        if matches >= MIN_MATCHES and set(pair) <= set(names):
            joined = [group for group in groups if group & set(pair)]
            groups = [group for group in groups if group not in joined] + [set().union(*joined)]
    return sorted((sorted(group, key=list(names).index) for group in groups), key=lambda g: (-len(g), g))


def weakest_link(names: Sequence[str], pairs: Pairs) -> tuple[str, str]:
    """The pair with the fewest matches among those that hold the photos together (a maximum spanning tree).

    `pairs` may have photos besides those in `names`.
    """
    group = {name: {name} for name in names}
    weakest = (names[0], names[1])
    inside = [pair for pair in pairs if set(pair) <= group.keys()]
    for pair in sorted(inside, key=lambda pair: -pairs[pair]):
        if group[pair[0]] is not group[pair[1]]:
            weakest = pair
            joined = group[pair[0]] | group[pair[1]]
            group.update(dict.fromkeys(joined, joined))
    return weakest


def gap(name: str, others: Sequence[str], pairs: Pairs) -> tuple[str, str]:
    """The photos beside a gap: one that is missing, and that of the others with most matches.

    `others` are in the order in which they were taken; where none matches, the one taken next to it counts.
    """
    in_order = sorted([*others, name])
    index = in_order.index(name)
    nearest = max(others, key=lambda other: (count(pairs, name, other), -abs(in_order.index(other) - index)))
    return (name, nearest) if in_order.index(nearest) > index else (nearest, name)


def table(names: Sequence[str], pairs: Pairs) -> str:
    """Verified matches of each pair, a row and a column for each photo."""
    width = max(4, *(len(str(matches)) for matches in pairs.values()))
    long = max(len(name) for name in names)
    meaning = f"{MIN_MATCHES} or more hold two photos together; a row of small numbers is the photo to take again"
    lines = [f"Matches of each pair ({meaning}):"]
    lines.append(" " * (4 + long) + "".join(f" {i:>{width}}" for i in range(1, len(names) + 1)))
    for i, name in enumerate(names, 1):
        cells = ("." if name == other else count(pairs, name, other) for other in names)
        lines.append(f"{i:>3} {name:<{long}}" + "".join(f" {cell:>{width}}" for cell in cells))
    return "\n".join(lines)


def what_would_help(name: str, others: Sequence[str], pairs: Pairs) -> str:
    """Which photo would have helped one that is left out, as the end of a sentence."""
    between = " and ".join(gap(name, others, pairs))
    return f"; if it is of the same place, a photo from between {between} would have helped"
