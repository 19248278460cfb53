"""Decides whether cameras can be trusted, and if not tells the user what to photograph next.

A low reprojection error proves nothing: a few matches fit wrong cameras as well. So the focal length has to be in the
range of real lenses, and either the photos or their Exif have to determine it; each photo has to see many points; and a
second solver, which uses other keypoints, has to find the same cameras.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import torch

from kgs._support.errors import PhotosRefused
from kgs.geometry.rigs import degrees_between

from .map import MIN_MATCHES, Cameras, PairGeometry

FOCAL_RANGE = 0.4, 3.0  # of the longer side
MIN_POINTS = 50  # that each photo sees
MAX_DEGREES = 2.0  # between the two solvers' rotations of a pair
MAX_RATIO = 1.15  # of their focal lengths
MIN_RISE = 0.03  # relative growth of the squared errors if the focal length is a quarter off
MIN_SHIFT = 1.0  # pixels; photos whose matches move less in the median were taken from one place
_PLANAR = 0.97  # share of matches that one homography explains; a scene with depth has a pair with a lower one
_WITHOUT = "To fit only some of the photos, take the others out of the folder"
_FORWARD = (
    "The camera moved along its view, as when walking forward: what lies ahead hardly moves between such photos, and "
    "nothing tells how far away it is. What helps most: step sideways, not forward, so that neighbours are 3 to 20 "
    "degrees apart"
)
Pairs = Mapping[tuple[str, str], int]  # verified matches of each pair


def objections(cameras: Cameras | None, names: Sequence[str], longest: int) -> list[str]:
    """The reasons to refuse one solver's cameras, a sentence each; empty if there are none.

    Args:
        cameras: what the solver found.
        names: the names of all photos.
        longest: the longer side of the photos in pixels.
    """
    if cameras is None:
        return ["no pair of photos gave a first guess of the cameras"]
    reasons = []
    if missing := _missing(cameras, names):
        reasons.append(f"{len(missing)} of {len(names)} photos could not be placed: {', '.join(missing)}")
    limits = f"{FOCAL_RANGE[0]:g} to {FOCAL_RANGE[1]:g}"
    ratios = sorted({focal / longest for focal in cameras.focals.values()})
    for ratio in (ratio for ratio in ratios if not FOCAL_RANGE[0] <= ratio <= FOCAL_RANGE[1]):
        reasons.append(f"the focal length came out at {ratio:.3g} times the longer side, where lenses have {limits}")
    if few := [f"{name} ({count})" for name, count in cameras.points.items() if count < MIN_POINTS]:
        reasons.append(f"fewer than {MIN_POINTS} points are seen in {', '.join(few)}")
    return reasons


def disagreement(first: Cameras, second: Cameras) -> tuple[float, tuple[str, str]]:
    """The largest angle, in degrees, between two solvers' relative rotations of a pair, and that pair.

    It is 180 for a pair of which one solver did not register both photos.
    """
    worst = (0.0, ("", ""))
    for pair in combinations(sorted({*first.rotations, *second.rotations}), 2):
        known = all(name in cameras.rotations for name in pair for cameras in (first, second))
        angle = angle_between(first, second, pair) if known else 180.0
        worst = max(worst, (angle, pair))
    return worst


def angle_between(first: Cameras, second: Cameras, pair: tuple[str, str]) -> float:
    """The angle between two solvers' rotations from one camera to another, in degrees."""
    both = [cameras.rotations[pair[1]] @ cameras.rotations[pair[0]].T for cameras in (first, second)]
    return float(degrees_between(*map(torch.from_numpy, both)))


def focal_doubt(solutions: Sequence[Cameras]) -> str:
    """Why neither solution determines the focal length; "" if one does."""
    rise = max(0.0, *(cameras.focal_rise for cameras in solutions))
    if rise >= MIN_RISE:
        return ""
    return f"where it is a quarter off, squared errors grow by {rise:.1%}, less than {MIN_RISE:.0%}"


def focal_difference(solutions: Sequence[Cameras]) -> str:
    """How far the solvers' focal lengths are apart, if that is too far; "" if it is not. Each lens counts."""
    registered = set[str].intersection(*(set(cameras.focals) for cameras in solutions))
    focals = [[cameras.focal for cameras in solutions]]
    focals += [[cameras.focals[name] for cameras in solutions] for name in registered]
    ratio = max(max(of_lens) / min(of_lens) for of_lens in focals)
    if ratio <= MAX_RATIO:
        return ""
    return f"those of two solvers differ by a factor of {ratio:.3g}, more than {MAX_RATIO:g}"


def judge(
    folder: Path,
    solutions: list[Cameras | None],
    names: list[str],
    longest: int,
    pairs: Pairs,
    *,
    forward: bool = False,
) -> tuple[int, float]:
    """The index of the cameras that pass the gates, and the solvers' largest difference in degrees.

    A PhotosRefused if none pass.

    If both pass, it is that of those whose worst photo sees more points.

    Args:
        folder: of the photos, which errors name.
        solutions: what each solver found, None where it found nothing.
        names: the names of all photos.
        longest: the longer side of the photos in pixels.
        pairs: verified matches of each pair.
        forward: whether the camera moved along its view, which is what a refusal then speaks of.
    """
    reasons = [objections(cameras, names, longest) for cameras in solutions]
    good = {i: cameras for i, cameras in enumerate(solutions) if cameras and not reasons[i]}
    if not good:
        raise PhotosRefused(folder, "", refusal(reasons[0], names, pairs, forward, _missing(solutions[0], names)))
    for cameras in solutions:  # nothing confirms a photo that only one solver registered
        if missing := _missing(cameras, names):
            who = ", ".join(missing)
            reason = f"kgs finds the cameras in two ways, and only one could place {who}, so that nothing confirms it"
            raise PhotosRefused(folder, "", refusal([reason], names, pairs, forward, missing))
    both = [cameras for cameras in solutions if cameras]
    if doubt := focal_doubt(both):
        raise PhotosRefused(folder, "", focal_refusal(doubt, names, pairs, forward))
    degrees, pair = disagreement(*both)
    if degrees > MAX_DEGREES:
        reason = (
            f"kgs finds the cameras in two ways, and they disagree about {' and '.join(pair)} (by "
            f"{degrees:.3g} degrees; expected at most {MAX_DEGREES:g})"
        )
        raise PhotosRefused(folder, "", refusal([reason], names, pairs, forward))
    if doubt := focal_difference(both):
        raise PhotosRefused(folder, "", focal_refusal(doubt, names, pairs, forward))
    sure = {i: cameras for i, cameras in good.items() if cameras.focal_rise >= MIN_RISE} or good
    return max(sure, key=lambda i: min(sure[i].points.values())), degrees


def groups_of(names: Sequence[str], pairs: Pairs) -> list[list[str]]:
    """Groups of photos that overlapping pairs connect, the largest first, each in the order of `names`."""
    groups = [{name} for name in names]
    for pair, count in pairs.items():
        if count >= MIN_MATCHES:
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
    """The photos beside a gap: one that could not be registered, and that of the others with most matches.

    `others` are in the order in which they were taken; where none matches, the one taken next to it counts.
    """
    in_order = sorted([*others, name])
    index = in_order.index(name)

    def closeness(other: str) -> tuple[int, int]:
        return matches_of(pairs, name, other), -abs(in_order.index(other) - index)

    nearest = max(others, key=closeness)
    return (name, nearest) if in_order.index(nearest) > index else (nearest, name)


def matches_of(pairs: Pairs, one: str, other: str) -> int:
    """The verified matches of two photos."""
    return pairs.get((one, other), pairs.get((other, one), 0))


def table(names: Sequence[str], pairs: Pairs) -> str:
    """Verified matches of each pair, a row and a column for each photo."""
    width = max(4, *(len(str(count)) for count in pairs.values()))
    long = max(len(name) for name in names)
    head = " " * (4 + long) + "".join(f" {i + 1:>{width}}" for i in range(len(names)))
    rows = [f"{i + 1:>3} {name:<{long}}" + _row(name, names, pairs, width) for i, name in enumerate(names)]
    meaning = f"{MIN_MATCHES} or more hold two photos together; a row of small numbers is the photo to take again"
    return "\n".join([f"Matches of each pair ({meaning}):", head, *rows])


def why_no_cameras(names: Sequence[str], pairs: Pairs, geometries: Mapping[tuple[str, str], PairGeometry]) -> str:
    """Why matches cannot give cameras, and what to photograph next, as an error message; "" if they can.

    Args:
        names: the names of all photos.
        pairs: verified matches of each pair.
        geometries: what the matches of each overlapping pair say about depth.
    """
    if twins := [pair for pair, geometry in geometries.items() if geometry.shift < MIN_SHIFT]:
        one, other = twins[0]
        return (
            f"{one} and {other} match at the same pixels: either they show the same from the same place, so remove one "
            "of them; or they carry the same watermark, caption or frame, so crop it from all photos"
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
    return f"no cameras: {reason}. {advice}. {_WITHOUT}.\n{table(names, pairs)}"


def is_forward(geometries: Mapping[tuple[str, str], PairGeometry]) -> bool:
    """Whether the camera moved along its view in every pair that shows depth."""
    telling = [geometry for geometry in geometries.values() if geometry.planar < _PLANAR]
    return bool(telling) and all(geometry.forward for geometry in telling)


def focal_refusal(doubt: str, names: Sequence[str], pairs: Pairs, forward: bool = False) -> str:
    """The error message if neither the photos nor their Exif determine the focal length; `doubt` says why."""
    if forward:
        reason = f"the photos do not tell the focal length, and their Exif does not say it: {doubt}"
        return f"no cameras that can be trusted: {reason}. {_FORWARD}.\n{table(names, pairs)}"
    return (
        "no cameras that can be trusted: the photos do not tell the focal length, as a rule because they are close "
        f"together, and their Exif does not say it: {doubt}, and the depth of the scene is as unsure. What helps: "
        "larger steps to the side or up, so that neighbours are 3 to 20 degrees apart; or the photos as the camera "
        f"wrote them, since messengers and many editors drop Exif.\n{table(names, pairs)}"
    )


def refusal(
    reasons: Iterable[str], names: Sequence[str], pairs: Pairs, forward: bool = False, missing: Sequence[str] = ()
) -> str:
    """The error message for cameras that cannot be trusted: the reasons, and what to photograph next.

    Photos are advised from beside the first of those that are `missing`, else where fewest matches hold them together.
    """
    if forward:
        return f"no cameras that can be trusted: {'; '.join(reasons)}. {_FORWARD}. {_WITHOUT}.\n{table(names, pairs)}"
    registered = [name for name in names if name not in missing]
    between = " and ".join(gap(missing[0], registered, pairs) if missing and registered else weakest_link(names, pairs))
    return (
        f"no cameras that can be trusted: {'; '.join(reasons)}. What helps most: photos from places between {between}, "
        "with steps to the side or up (turning on the spot shows no depth), so that neighbours share two thirds of the "
        f"scene; a scene with texture; all with one lens, without zoom. {_WITHOUT}. With cameras of your own: a folder "
        f"with images/ and sparse/0 from COLMAP.\n{table(names, pairs)}"
    )


def _missing(cameras: Cameras | None, names: Sequence[str]) -> list[str]:
    """The photos that a solver did not register."""
    return [name for name in names if cameras is None or name not in cameras.points]


def _row(name: str, names: Sequence[str], pairs: Pairs, width: int) -> str:
    cells = ("." if name == other else matches_of(pairs, name, other) for other in names)
    return "".join(f" {cell:>{width}}" for cell in cells)
