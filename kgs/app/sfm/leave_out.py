"""Decides which photos are left out, so that one unsuitable photo does not stop the others.

A photo is left out if it is a copy, or of another shape than most while no Exif says its focal length; if it shows
another place, or the same from the same place as another one; or if its camera cannot be trusted: each solver has to
register it, it has to see enough points, and both have to agree about it and its lens, if need be at a second look
(:mod:`kgs.app.sfm.second_look`). At least three photos remain, or nothing is left out and the gates refuse all.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations

from kgs._support.errors import PhotosRefused

from .find import MIN_PHOTOS, listed_files
from .gates import MAX_DEGREES, MAX_RATIO, MIN_POINTS, MIN_SHIFT, Pairs, angle_between, gap, groups_of, matches_of
from .map import Cameras, PairGeometry
from .read import OpenPhoto, by_shape


def unlike_others(photos: list[OpenPhoto]) -> dict[str, str]:
    """Photos that are copies, or of another shape than most without a focal length in their Exif, and why.

    Raises:
        PhotosRefused: most photos are panoramas, there are fewer than `MIN_PHOTOS` without copies, or no shape is that
            of most.
    """
    folder = photos[0].path.parent
    panoramas = [photo.path for photo in photos if photo.is_panorama]
    if 2 * len(panoramas) > len(photos):
        line = f'ffmpeg -i "{panoramas[0].name}" -vf v360=e:rectilinear:h_fov=90:v_fov=67:yaw=0 yaw_0.jpg'
        advice = f"cut some from it: `{line}`, the same for other angles"
        raise PhotosRefused(panoramas[0], "", "a picture of a lens", "a panorama", advice=advice)
    first = {photo.sha256: photo.name for photo in reversed(photos)}
    copied = {photo.name: first[photo.sha256] for photo in photos if first[photo.sha256] != photo.name}
    left = {name: f"it is the same photo as {other}" for name, other in copied.items()}
    if copied and len(photos) - len(left) < MIN_PHOTOS:
        name, other = next(iter(copied.items()))
        advice = "two copies show no depth. Remove one, and take another photo from a step to the side"
        path = photos[0].path.with_name(name)
        raise PhotosRefused(path, "", f"another photo than {other}", "the same", advice=advice)
    photos = [photo for photo in photos if photo.name not in left]
    shapes = by_shape(photos)
    if (usual := _usual(shapes)) is None:
        advice = "keep one group in the folder. Cropped photos do not fit those that are whole"
        raise PhotosRefused(folder, "", "photos of one shape", f"{len(shapes)} ({_listed(shapes)})", advice=advice)
    return left | {
        photo.name: f"its shape is {name}, not {usual}, and no Exif says its focal length: is it cropped?"
        for photo, name in _of_unknown_lens(shapes, usual)
    }


def _usual(groups: Mapping[str, list[OpenPhoto]]) -> str | None:
    """The largest group, or None if others would be left out, and it has too few photos or no more than another one."""
    usual = max(groups, key=lambda name: len(groups[name]))
    sizes = sorted((len(group) for group in groups.values()), reverse=True)
    if _of_unknown_lens(groups, usual) and (sizes[0] < MIN_PHOTOS or sizes[0] == sizes[1]):
        return None
    return usual


def _of_unknown_lens(groups: Mapping[str, list[OpenPhoto]], usual: str) -> list[tuple[OpenPhoto, str]]:
    """The photos of other groups, and the name of each one's group, whose Exif says no focal length."""
    others = [(photo, name) for name, group in groups.items() for photo in group if name != usual]
    return [(photo, name) for photo, name in others if not photo.focal_ratio]


def _listed(groups: Mapping[str, list[OpenPhoto]]) -> str:
    return "; ".join(f"{name}: {listed_files([photo.path for photo in group])}" for name, group in groups.items())


def without_overlap(
    names: Sequence[str], pairs: Pairs, geometries: Mapping[tuple[str, str], PairGeometry]
) -> dict[str, str]:
    """Photos that cannot help, by their matches alone, and why.

    The second of two photos from one place, and photos outside the largest group that overlapping pairs connect, if
    that is larger than any other.

    Args:
        names: the names of all photos.
        pairs: verified matches of each pair.
        geometries: what the matches of each overlapping pair say about depth.
    """
    left = {
        second: f"it shows the same from the same place as {first}"
        for (first, second), geometry in geometries.items()
        if geometry.shift < MIN_SHIFT
    }
    kept = [name for name in names if name not in left]
    groups = groups_of(kept, pairs)
    if len(groups) > 1 and len(groups[0]) > len(groups[1]):
        left |= {name: _too_few_matches(name, groups[0], pairs) for group in groups[1:] for name in group}
    return left if len(names) - len(left) >= MIN_PHOTOS else {}


def without_cameras(solutions: Sequence[Cameras | None], names: Sequence[str], pairs: Pairs) -> dict[str, str]:
    """Photos whose cameras cannot be trusted while those of at least `MIN_PHOTOS` others can, and why.

    Args:
        solutions: what two solvers found.
        names: the names of the photos that they were given.
        pairs: verified matches of each pair.
    """
    first, second = solutions
    if first is None or second is None:
        return {}
    # without photos that were registered badly the solvers may agree about the others
    left = _registered_badly(first, second, names, pairs) or _disputed(first, second, list(names))
    return left if len(names) - len(left) >= MIN_PHOTOS else {}


def doubtful(solutions: Sequence[Cameras | None], names: Sequence[str], pairs: Pairs) -> set[str]:
    """Photos whose cameras cannot be trusted, also where too few others remain; all of them if a solver has none."""
    first, second = solutions
    if first is None or second is None:
        return set(names)
    left = _registered_badly(first, second, names, pairs)
    return {*left, *_disputed(first, second, [name for name in names if name not in left])}


def _registered_badly(first: Cameras, second: Cameras, names: Sequence[str], pairs: Pairs) -> dict[str, str]:
    """The photos that a solver did not register, that see few points, or whose lens is disputed, and why."""
    left = dict[str, str]()
    for name in names:
        solvers = (name in first.points) + (name in second.points)
        if solvers < 2:
            who = "only one of two solvers" if solvers else "neither of two solvers"
            left[name] = f"{who} could place it{_advice(name, names, pairs)}"
    registered = [name for name in names if name not in left]
    better = max((first, second), key=lambda cameras: _seen_well(cameras, registered))
    for name in registered:
        if better.points[name] < MIN_POINTS:
            few = f"only {better.points[name]} points are seen in it, fewer than {MIN_POINTS}"
            left[name] = f"{few}{_advice(name, names, pairs)}"
    return left | _other_lenses(first, second, [name for name in names if name not in left])


def _other_lenses(first: Cameras, second: Cameras, names: list[str]) -> dict[str, str]:
    """The photos by another lens than most, about whose focal length the solvers disagree."""
    ratios = {name: first.focals[name] / second.focals[name] for name in names if first.focals[name] != first.focal}
    return {
        name: f"two solvers differ by a factor of {max(ratio, 1 / ratio):.3g} about the focal length of its lens"
        for name, ratio in ratios.items()
        if max(ratio, 1 / ratio) > MAX_RATIO
    }


def _disputed(first: Cameras, second: Cameras, names: list[str]) -> dict[str, str]:
    """The photos without which both solvers agree about all pairs: at each turn that in most pairs they differ about.

    Fewer than three may be left.
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


def _seen_well(cameras: Cameras, names: Sequence[str]) -> tuple[int, int]:
    """How many photos see enough points, and how many the worst one sees."""
    counts = [cameras.points[name] for name in names]
    return sum(count >= MIN_POINTS for count in counts), min(counts, default=0)


def _too_few_matches(name: str, group: Sequence[str], pairs: Pairs) -> str:
    maximum = max(matches_of(pairs, name, other) for other in group)
    said = f"it has at most {maximum} matches with the others" if maximum else "it shows nothing that the others show"
    return f"{said}{_advice(name, [*group, name], pairs)}"


def _advice(name: str, names: Sequence[str], pairs: Pairs) -> str:
    between = " and ".join(gap(name, [other for other in names if other != name], pairs))
    return f"; if it is of the same place, a photo from between {between} would have helped"
