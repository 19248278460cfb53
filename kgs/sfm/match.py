"""Keypoints of photos and their matches, written into a COLMAP database and verified there.

Source: L. Cavalli et al., AdaLAM, ECCV 2020 (matches that agree with their neighbours).
"""

from itertools import combinations
from pathlib import Path
from statistics import median_high
from typing import Any, NamedTuple

import torch
from kornia.feature import laf_from_center_scale_ori, match_adalam
from torch import Tensor

from kgs.io.console import Stage

from .keypoints import root_sift
from .read import Photo

SMALL = 1000  # pixels of the longer side; SIFT sees smaller photos at twice their size
KEYPOINTS = 4096, 8192, 24_576  # of one photo at least and at most; of all photos together
_CONTRAST = 0.01
_CHUNK = 512  # keypoints compared at once: bounds the memory
_FEWEST = 8  # matches of a pair that are worth verifying
DEFAULT_FOCAL = 0.8  # of the longer side, where the files do not say it: as of phones (0.7 to 0.8)


class Framed(NamedTuple):
    """Keypoints of one photo, as COLMAP and Kornia take them."""

    places: Tensor  # `(N, 2)` float32, the first pixel's centre is (0.5, 0.5)
    descriptors: Tensor  # `(N, 128)` float32, RootSIFT
    frames: Tensor  # `(1, N, 2, 3)`, Kornia's local affine frames


def find_keypoints(photo: Photo, most: int) -> Framed:
    """The strongest SIFT keypoints of a photo, up to `most`; nothing is random."""
    factor = 2 if max(photo.size) < SMALL else 1
    found = root_sift(photo.grey(), most, factor, contrastThreshold=_CONTRAST)
    places, sizes, angles = (found.places + 0.5).float(), found.sizes.float(), found.angles.float()
    frames = laf_from_center_scale_ori(places[None], sizes[None, :, None, None], angles[None, :, None])
    return Framed(places, found.descriptors, frames)


def write_matches(database: Path, photos: list[Photo], names: list[str], stage: Stage) -> None:
    """Make a COLMAP database of all photos with one lens, their keypoints and the matches of each pair.

    Args:
        database: the file to write.
        photos: the photos, all of one size.
        names: their names in the database.
        stage: shows how far the work is.
    """
    fewest, most, total = KEYPOINTS  # the cost of matching grows with the squares of both counts
    most = min(most, max(fewest, total // len(photos)))
    found = [find_keypoints(photo, most) for photo in stage(photos, "keypoints", "photo")]
    area = photos[0].size[::-1]
    with _open(database) as file:
        ids = _write_photos(file, photos, names)
        for image_id, keypoints in zip(ids, found, strict=True):
            file.write_keypoints(image_id, keypoints.places.numpy())
        for i, j in stage(list(combinations(range(len(photos)), 2)), "matches", "pair"):
            pairs = _match(found[i], found[j], area)
            if len(pairs) >= _FEWEST:
                file.write_matches(ids[i], ids[j], pairs.numpy().astype("uint32"))


def _match(first: Framed, second: Framed, area: tuple[int, ...]) -> Tensor:
    """Numbers of keypoints that match, `(M, 2)`: each other's nearest in descriptors, as AdaLAM finds them to agree."""
    if min(len(first.places), len(second.places)) < _FEWEST:
        return torch.zeros(0, 2, dtype=torch.int64)
    nearest1, best2, nearest2 = [], torch.full((len(second.places),), -1.0), torch.zeros(len(second.places)).long()
    for start in range(0, len(first.places), _CHUNK):
        products = first.descriptors[start : start + _CHUNK] @ second.descriptors.T
        nearest1.append(products.argmax(1))
        best, rows = products.max(0)
        nearest2 = torch.where(best > best2, rows + start, nearest2)
        best2 = torch.maximum(best, best2)
    columns = torch.cat(nearest1)
    rows = (nearest2[columns] == torch.arange(len(columns))).nonzero()[:, 0]
    columns = columns[rows]
    if len(rows) < _FEWEST:
        return torch.zeros(0, 2, dtype=torch.int64)
    (_, descriptors1, frames1), (_, descriptors2, frames2) = first, second
    arguments = (descriptors1[rows], descriptors2[columns], frames1[:, rows], frames2[:, columns])
    _, pairs = match_adalam(*arguments, hw1=area, hw2=area)
    return torch.stack([rows[pairs[:, 0]], columns[pairs[:, 1]]], dim=1)


def _open(database: Path) -> Any:
    import pycolmap

    return pycolmap.Database.open(database)


def exif_focal(photos: list[Photo]) -> float | None:
    """The focal length in pixels as the files say, None where none does."""
    known = [photo.focal for photo in photos if photo.focal]
    return median_high(known) if known else None


def lens_of(photos: list[Photo]) -> Any:
    """What is known of the one lens of all photos, as pycolmap has it."""
    import pycolmap

    width, height = photos[0].size
    known = exif_focal(photos)
    focal = known or DEFAULT_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, width, height)
    camera.has_prior_focal_length = known is not None
    return camera


def _write_photos(file: Any, photos: list[Photo], names: list[str]) -> list[int]:
    """Write one lens for all photos, and the photos; returns their ids."""
    import pycolmap

    camera = lens_of(photos)
    camera.camera_id = file.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    rig_id, ids = file.write_rig(rig), []
    for name in names:
        image = pycolmap.Image(name=name, camera_id=camera.camera_id)
        image.image_id = file.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = rig_id
        frame.add_data_id(image.data_id)
        file.write_frame(frame)
        ids.append(image.image_id)
    return ids
