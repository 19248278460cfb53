"""Finds keypoints of photos, matches them in pairs, and writes both into a COLMAP database.

Source: L. Cavalli et al., AdaLAM, ECCV 2020 (keeps matches that agree with their neighbours).
"""

from itertools import combinations
from pathlib import Path
from statistics import median_high
from typing import Any, NamedTuple

import torch
from kornia.feature import laf_from_center_scale_ori, match_adalam
from torch import Tensor

from kgs._support.progress import ProgressBar
from kgs.init_points.keypoints import root_sift

from .colmap import pycolmap
from .read import DEFAULT_FOCAL, Photo
from .write import write_images

SMALL = 1000  # pixels of the longer side; SIFT sees smaller photos at twice their size
MIN_KEYPOINTS = 4096  # of one photo
MAX_KEYPOINTS = 8192  # of one photo
ALL_KEYPOINTS = 24_576  # of all photos together, if that leaves each one `MIN_KEYPOINTS`
_CONTRAST = 0.01
_CHUNK = 512  # keypoints compared at once: bounds the memory
_MIN_MATCHES = 8  # matches of a pair that are worth verifying


class PhotoKeypoints(NamedTuple):
    """Keypoints of one photo, as COLMAP and Kornia take them."""

    pixels: Tensor  # `(N, 2)` float32, the first pixel's centre is (0.5, 0.5)
    descriptors: Tensor  # `(N, 128)` float32, RootSIFT
    frames: Tensor  # `(1, N, 2, 3)`, Kornia's local affine frames


def find_keypoints(photo: Photo, max_count: int) -> PhotoKeypoints:
    """The strongest SIFT keypoints of a photo where it is kept, up to `max_count`."""
    factor = 2 if max(photo.size) < SMALL else 1
    keypoints = root_sift(photo.grey(), max_count, factor, photo.mask, contrastThreshold=_CONTRAST)
    pixels = (keypoints.pixels + 0.5).float()
    sizes = keypoints.sizes.float()
    angles = keypoints.angles.float()
    frames = laf_from_center_scale_ori(pixels[None], sizes[None, :, None, None], angles[None, :, None])
    return PhotoKeypoints(pixels, keypoints.descriptors, frames)


def write_matches(database: Path, photos: list[Photo], names: list[str], lenses: list[Any], bar: ProgressBar) -> None:
    """Make a COLMAP database of photos of one size with their lenses, keypoints and the matches of each pair."""
    # The cost of matching grows with the squares of both counts, so many photos get fewer keypoints each.
    max_count = min(MAX_KEYPOINTS, max(MIN_KEYPOINTS, ALL_KEYPOINTS // len(photos)))
    keypoints = [find_keypoints(photo, max_count) for photo in bar(photos, "keypoints", "photo")]
    area = photos[0].size[::-1]
    with pycolmap.Database.open(database) as file:
        ids = _write_photos(file, photos, names, lenses)
        for image_id, of_photo in zip(ids, keypoints, strict=True):
            file.write_keypoints(image_id, of_photo.pixels.numpy())
        for i, j in bar(list(combinations(range(len(photos)), 2)), "matches", "pair"):
            pairs = _match(keypoints[i], keypoints[j], area)
            if len(pairs) >= _MIN_MATCHES:
                file.write_matches(ids[i], ids[j], pairs.numpy().astype("uint32"))


def _match(first: PhotoKeypoints, second: PhotoKeypoints, area: tuple[int, ...]) -> Tensor:
    """Indices of matching keypoints, `(M, 2)`: mutual nearest neighbours among descriptors that pass AdaLAM."""
    if min(len(first.pixels), len(second.pixels)) < _MIN_MATCHES:
        return torch.zeros(0, 2, dtype=torch.int64)
    nearest1 = []
    best2 = torch.full((len(second.pixels),), -1.0)
    nearest2 = torch.zeros(len(second.pixels), dtype=torch.int64)
    for start in range(0, len(first.pixels), _CHUNK):
        products = first.descriptors[start : start + _CHUNK] @ second.descriptors.T
        nearest1.append(products.argmax(1))
        best, rows = products.max(0)
        nearest2 = torch.where(best > best2, rows + start, nearest2)
        best2 = torch.maximum(best, best2)
    columns = torch.cat(nearest1)
    rows = (nearest2[columns] == torch.arange(len(columns))).nonzero()[:, 0]
    columns = columns[rows]
    if len(rows) < _MIN_MATCHES:
        return torch.zeros(0, 2, dtype=torch.int64)
    _, pairs = match_adalam(
        first.descriptors[rows],
        second.descriptors[columns],
        first.frames[:, rows],
        second.frames[:, columns],
        hw1=area,
        hw2=area,
    )
    return torch.stack([rows[pairs[:, 0]], columns[pairs[:, 1]]], dim=1)


def exif_focal(photos: list[Photo]) -> float | None:
    """The median focal length in pixels that the photos' Exif gives, None if none does."""
    known = [photo.focal for photo in photos if photo.focal]
    return median_high(known) if known else None


def lenses_of(photos: list[Photo]) -> list[Any]:
    """First guesses of the photos' lenses, as cameras of pycolmap, in the order of their numbers."""
    width, height = photos[0].size
    cameras = []
    for number in range(1 + max(photo.lens for photo in photos)):
        known = exif_focal([photo for photo in photos if photo.lens == number])
        focal = known or DEFAULT_FOCAL * max(width, height)
        camera = pycolmap.Camera.create_from_model_name(number + 1, "SIMPLE_RADIAL", focal, width, height)
        camera.has_prior_focal_length = known is not None
        cameras.append(camera)
    return cameras


def _write_photos(file: Any, photos: list[Photo], names: list[str], lenses: list[Any]) -> list[int]:
    """The ids of the photos, which are written with their lenses."""
    rig_ids = []
    for lens in lenses:
        lens.camera_id = file.write_camera(lens)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(lens.sensor_id)
        rig_ids.append(file.write_rig(rig))
    ids = []
    for photo, name in zip(photos, names, strict=True):
        image = pycolmap.Image(name=name, camera_id=lenses[photo.lens].camera_id)
        image.image_id = file.write_image(image)
        frame = pycolmap.Frame()
        frame.rig_id = rig_ids[photo.lens]
        frame.add_data_id(image.data_id)
        file.write_frame(frame)
        ids.append(image.image_id)
    return ids


def colmap_matching(
    photos: list[Photo], lenses: list[Any], images: Path, masks: Path, work: Path, names: list[str]
) -> dict[str, Any]:
    """What the step `write_colmap_matches` takes: folders, names of each lens's photos, and the lens if it is known.

    Photos with alpha are written again over black: COLMAP would find keypoints in what alpha hides.
    """
    if not all(photo.is_opaque for photo in photos):
        images = work / "opaque"
        images.mkdir()
        write_images(images, photos, names, opaque=True)
    of_lens = []
    for number, lens in enumerate(lenses):
        shown = [name for photo, name in zip(photos, names, strict=True) if photo.lens == number]
        of_lens.append((shown, lens.params_to_string() if lens.has_prior_focal_length else None))
    return {"images": str(images), "masks": str(masks) if masks.is_dir() else None, "lenses": of_lens}
