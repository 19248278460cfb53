"""Photos between which something was moved: two groups that one small, flat thing alone holds together.

A thing that lies elsewhere in the later photos, as a book or a chessboard, matches as well as before. Solvers place
all photos around it, agree, and are wrong about the rest: the groups show different surroundings in one place. The
parts of one scene share more than that: in sets of photos that are right, the points that join two groups are seen in
0.4 and more of some photo; of two desks with one chessboard in 0.24 (docs/results/cameras).
"""

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MIN_OWN = 50  # points that each group sees and the other does not
_SMALL = 0.35  # largest share of a photo's cells with points, in which it sees points that join
_FLAT = 0.06  # largest thickness of the points that join, over their extent
_CELLS = 8  # of a photo, along each side
_KEPT = 0.95  # of the points decide where the plane is, and how thick they are


def moved_photos(reconstruction: Any) -> list[str]:
    """The images of the smaller of two groups that one small, flat thing alone joins, or [].

    Photos are joined in the order of the points that they share, those with most first; each time two groups of two
    photos or more meet, the points that both see are looked at. Groups that such a thing joins stay apart, and the
    other photos come to either.

    Args:
        reconstruction: pycolmap's, of the photos of one scene or of two.
    """
    images = sorted(reconstruction.reg_image_ids())
    points = np.array([point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3)
    cells = _cells(reconstruction, images)
    is_seen = cells >= 0
    shared = is_seen.T.astype(np.int64) @ is_seen
    groups = [frozenset([i]) for i in range(len(images))]
    apart: tuple[int, ...] = ()  # a photo of each of the two groups that stay apart
    for i, j in sorted(combinations(range(len(images)), 2), key=lambda pair: -int(shared[pair])):
        one, other = groups[i], groups[j]
        if one == other or {one, other} == {groups[k] for k in apart}:
            continue
        if not apart and _is_one_flat_thing(points, cells, [*one], [*other]):
            apart = (i, j)
            continue
        joined = one | other
        groups = [joined if k in joined else group for k, group in enumerate(groups)]
    smaller = min((groups[k] for k in apart), key=len, default=frozenset[int]())
    return [reconstruction.images[images[k]].name for k in sorted(smaller)]


def _cells(reconstruction: Any, images: list[int]) -> NDArray[np.int64]:
    """In which of the 64 cells of each image a point is seen, `(points, images)`; -1 where it is not."""
    cells = np.full((reconstruction.num_points3D(), len(images)), -1)
    columns = {image: column for column, image in enumerate(images)}
    for row, point in enumerate(reconstruction.points3D.values()):
        for element in point.track.elements:
            image = reconstruction.images[element.image_id]
            size = image.camera.width, image.camera.height
            x, y = np.clip(image.points2D[element.point2D_idx].xy / size * _CELLS, 0, _CELLS - 1).astype(np.int64)
            cells[row, columns[element.image_id]] = x * _CELLS + y
    return cells


def _is_one_flat_thing(points: NDArray[np.float64], cells: NDArray[np.int64], one: list[int], other: list[int]) -> bool:
    """Whether all that two groups of columns share is flat, and small in every photo, and each sees much beside it."""
    in_one, in_other = ((cells[:, group] >= 0).any(1) for group in (one, other))
    joining = in_one & in_other
    if min(len(one), len(other)) < 2 or min((in_one & ~joining).sum(), (in_other & ~joining).sum()) < _MIN_OWN:
        return False
    shares = []
    for seen in cells[:, [*one, *other]].T:
        shares.append(len(np.unique(seen[joining & (seen >= 0)])) / max(1, len(np.unique(seen[seen >= 0]))))
    return max(shares) < _SMALL and _thickness(points[joining]) < _FLAT


def _thickness(points: NDArray[np.float64]) -> float:
    """How far points are from their plane, over how far they are from their centre; a few may lie anywhere."""
    kept = points
    for _ in range(3):
        centre = kept.mean(0)
        normal = np.linalg.svd(kept - centre, full_matrices=False)[2][-1]
        distances = np.abs((points - centre) @ normal)
        kept = points[distances <= np.quantile(distances, _KEPT)]
    extent = np.quantile(np.linalg.norm(points - centre, axis=1), _KEPT)
    return float(np.quantile(distances, _KEPT) / max(extent, np.finfo(np.float64).tiny))
