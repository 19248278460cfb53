"""Reads photos as a phone wrote them: decoded, turned upright, reduced to one size, with what Exif says of the lens.

Upright and lying photos are one lens's: for the solvers, those of the rarer kind lie on their side. Photos whose focal
length differs, by a zoom or another phone, are of a lens of their own. Of photos of a rarer shape the middle is taken.
"""

import hashlib
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL.ExifTags import Base

from kgs._support.errors import DataError, PhotosRefused
from kgs._support.progress import ProgressBar
from kgs.datasets import folders, image_file
from kgs.datasets.image_file import Image, ImageFile, turn
from kgs.datasets.images import Intrinsics, reduce
from kgs.datasets.masks import Mask, MaskFiles

from .find import CONVERT, MIN_PHOTOS, listed_files

LONGEST = 1600  # pixels of the longer side, for matching and for what is written
FILM_DIAGONAL = math.hypot(36, 24)  # mm
DEFAULT_FOCAL = 0.8  # of the longer side, if Exif does not say it; phones have 0.7 to 0.8
_UNITS = {2: 25.4, 3: 10.0, 4: 1.0}  # mm, in which the density of pixels is given
_LENSES = 0.2, 10.0  # focal lengths over the longer side: a fisheye of 8 mm, a telephoto lens of 360 mm
_PANORAMA = b"equirectangular"  # in XMP, https://developers.google.com/streetview/spherical-metadata
_SAME_ZOOM = 1.1  # largest ratio of focal lengths that counts as one lens without zoom
_KERNEL = 33  # pixels of the smoothing, four standard deviations to each side
_BLURRED = 0.5  # a photo below this share of the median sharpness is blurred


class Exif(NamedTuple):
    """What a photo's Exif says about orientation and focal length. None stands for nothing.

    Sources: Exif 2.32 (CIPA DC-008, 4.6); CIPA DCG-001 for the length on 35 mm film, which compares diagonals.
    """

    orientation: int = 1  # 1 (upright) to 8
    focal_35mm: float | None = None  # in mm
    focal_over_width: float | None = None  # of the stored image, from the density of its pixels on the sensor

    @classmethod
    def of(cls, tags: Mapping[int, Any]) -> Self:
        """Read it from an image's tags. A damaged tag counts as missing."""
        orientation = int(_number(tags, Base.Orientation))
        film = _number(tags, Base.FocalLengthIn35mmFilm)
        focal = _number(tags, Base.FocalLength)
        density = _number(tags, Base.FocalPlaneXResolution)
        width = _number(tags, Base.ExifImageWidth)
        unit = _UNITS.get(int(_number(tags, Base.FocalPlaneResolutionUnit) or 2), 0.0)
        ratio = focal * density / (unit * width) if unit and width else 0.0
        return cls(orientation if 1 <= orientation <= 8 else 1, film or None, ratio or None)

    @property
    def is_sideways(self) -> bool:
        """Whether the upright photo is the stored image turned by 90 degrees, so that width and height swap."""
        return self.orientation > 4

    def focal_ratio(self, width: int, height: int) -> float | None:
        """The focal length over the longer side of a photo of this shape, if a lens has it, or None."""
        stored = height if self.is_sideways else width
        over_film = (self.focal_35mm or 0.0) / FILM_DIAGONAL * math.hypot(width, height) / max(width, height)
        over_sensor = (self.focal_over_width or 0.0) * stored / max(width, height)
        return next((ratio for ratio in (over_film, over_sensor) if _LENSES[0] <= ratio <= _LENSES[1]), None)


def _number(tags: Mapping[int, Any], tag: int) -> float:
    """A tag's number above 0, the first if there are several, or 0."""
    value = tags.get(tag)
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]  # None is a TypeError
    except (TypeError, ValueError, ZeroDivisionError, IndexError, OverflowError):
        return 0.0
    return number if 0 < number < math.inf else 0.0


class OpenPhoto(NamedTuple):
    """A photo whose file is read, and decoded later."""

    path: Path
    sha256: str
    exif: Exif
    size: tuple[int, int]  # width and height of the upright photo
    image: ImageFile
    mask: Mask | None

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name

    @property
    def is_panorama(self) -> bool:
        """Whether it has the shape 2:1, and its metadata say that it shows all around."""
        width, height = self.size
        return abs(width - 2 * height) <= 2 and _PANORAMA in self.image.load()

    @property
    def focal_ratio(self) -> float | None:
        """The focal length over the longer side that Exif gives, or None."""
        return self.exif.focal_ratio(*self.size)

    @property
    def has_odd_focal(self) -> bool:
        """Whether the Exif gives focal lengths, none of which a lens has."""
        return bool(self.exif.focal_35mm or self.exif.focal_over_width) and not self.focal_ratio


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo, reduced, and as wide and high as all others."""

    path: Path
    exif: Exif
    pixels: NDArray[np.uint8]  # `(H, W, 3)` RGB or `(H, W, 4)` RGBA, not premultiplied
    mask: NDArray[np.uint8] | None = None  # `(H, W)`, 255 where the photo is kept, 0 elsewhere; None: all is
    focal: float | None = None  # focal length in pixels that Exif gives, None if it does not
    lens: int = 0  # the number of its lens; 0 took most photos
    is_turned: bool = False  # whether it is upright only after a quarter turn counterclockwise
    is_cut: bool = False  # whether it is the middle of a photo of another shape

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.pixels.shape[:2]
        return width, height

    def upright(self) -> Self:
        """The photo as it is looked at."""
        if not self.is_turned:
            return self
        mask = None if self.mask is None else np.rot90(self.mask)
        return replace(self, pixels=np.rot90(self.pixels), mask=mask, is_turned=False)

    @property
    def is_opaque(self) -> bool:
        """Whether all pixels are opaque: the photo has three channels."""
        return bool(self.pixels.shape[2] == 3)

    def opaque(self) -> NDArray[np.uint8]:
        """The photo over black, `(H, W, 3)`, which hides what is under alpha."""
        rgb = self.pixels[..., :3]
        return rgb if self.is_opaque else (rgb * (self.pixels[..., 3:] / 255.0)).round().astype(np.uint8)

    def grey(self) -> NDArray[np.uint8]:
        """Brightness `(H, W)`, black where the photo is transparent."""
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(self.opaque()), cv2.COLOR_RGB2GRAY), np.uint8)


def open_photos(paths: Sequence[Path], masks: MaskFiles) -> list[OpenPhoto]:
    """Open photos and read their bytes, which `read_photos` decodes; DataError of a file that is not a photo."""
    opened = []
    for path in paths:
        image = ImageFile(path)
        data = image.load()
        if data[4:8] == b"ftyp" and not (image_file.is_heic(data) and folders.has_heic()):
            raise DataError(path, "", "a photo", "a HEIC photo or a video under another name", advice=CONVERT)
        exif = Exif.of(image.metadata.tags)
        size = image.size[::-1] if exif.is_sideways else image.size
        opened.append(OpenPhoto(path, hashlib.sha256(data).hexdigest(), exif, size, image, masks.of(path)))
    return opened


def read_photos(opened: list[OpenPhoto], bar: ProgressBar) -> list[Photo]:
    """Decode photos, turn them as their Exif says, and reduce them to the size of the smallest or to 1600 pixels.

    All get the shape of most, or that and its upright or lying counterpart; of these two the rarer is turned. Of photos
    of another shape the middle is taken, so that the lens stays centred.

    Raises:
        DataError: a photo cannot be decoded.
    """
    lying_is_usual = 2 * sum(photo.size[0] > photo.size[1] for photo in opened) >= len(opened)
    usual = max(by_shape(opened).values(), key=len)[0].size
    lies = [width > height or (width == height and lying_is_usual) for width, height in (p.size for p in opened)]
    parts = [_middle(photo.size, usual, lying) for photo, lying in zip(opened, lies, strict=True)]
    width, height = min(sorted(part, reverse=lying_is_usual) for part in parts)
    scale = min(1.0, LONGEST / max(width, height))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    lenses = _lens_numbers(opened)
    photos = []
    for photo, lying, part in zip(bar(opened, "photos", "photo"), lies, parts, strict=True):
        is_turned = lying != lying_is_usual and width != height
        kept_size = size[::-1] if is_turned else size
        # width and height of the whole photo where its part has this size
        whole = round(kept_size[0] * photo.size[0] / part[0]), round(kept_size[1] * photo.size[1] / part[1])
        pixels = np.ascontiguousarray(turn(photo.image.read(), photo.exif.orientation))
        kept = _kept(photo)
        image = _reduced(pixels, whole, kept)
        mask = None if kept is None else np.where(reduce(kept, *whole) >= 0.5, np.uint8(255), np.uint8(0))
        ratio = photo.exif.focal_ratio(*whole)
        quarters = -1 if is_turned else 0  # clockwise
        photos.append(
            Photo(
                photo.path,
                photo.exif,
                np.ascontiguousarray(np.rot90(_cut(image, kept_size), quarters)),
                None if mask is None else np.ascontiguousarray(np.rot90(_cut(mask, kept_size), quarters)),
                ratio * max(whole) if ratio else None,
                lenses[photo.name],
                is_turned,
                is_cut=whole != kept_size,
            )
        )
    return photos


def _middle(size: tuple[int, int], shape: tuple[int, int], lies: bool) -> tuple[int, int]:
    """Width and height of the largest lying, or else upright, part of an image that has this shape."""
    if _same_shape(size, shape):
        return size
    width, height = size
    ratio = max(shape) / min(shape) if lies else min(shape) / max(shape)
    return min(width, round(height * ratio)), min(height, round(width / ratio))


def _cut(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """The middle of an image."""
    height, width = image.shape[:2]
    left = (width - size[0]) // 2
    top = (height - size[1]) // 2
    return image[top : top + size[1], left : left + size[0]]


def _reduced(image: Image, size: tuple[int, int], kept: Image | None) -> NDArray[np.uint8]:
    """An image of 8 bits with this width and height, of the visible colours of the given one alone.

    It is RGB or RGBA, not premultiplied, in [0, 1]; `kept` is the share of each pixel that a mask keeps, `(H, W)`.
    """
    if image.shape[2] == 3:
        return _eight_bits(reduce(image, *size, kept))
    alpha = np.ascontiguousarray(image[..., 3])
    colors = reduce(np.ascontiguousarray(image[..., :3]), *size, alpha if kept is None else alpha * kept)
    levels = _eight_bits(np.dstack([colors, reduce(alpha, *size, kept)]))
    levels[levels[..., 3] == 0] = 0
    return levels


def _eight_bits(image: Image) -> NDArray[np.uint8]:
    return np.asarray((image.clip(0, 1) * 255).round(), np.uint8)


def _kept(photo: OpenPhoto) -> Image | None:
    """The share of each pixel of the upright photo that its mask keeps, `(H, W)`, or None.

    The file is upright, too, unless its shape is that of the stored photo.

    Raises:
        DataError: it cannot be read, has another shape, or keeps nothing.
    """
    if photo.mask is None:
        return None
    photo.mask.load()
    is_upright = Intrinsics(*photo.size, 1, 1, 0, 0).same_aspect(*photo.mask.size)
    orientation = photo.exif.orientation if photo.exif.is_sideways and not is_upright else 1
    kept = photo.mask.kept(photo.path, *(photo.size[::-1] if orientation > 1 else photo.size))
    return np.ascontiguousarray(turn(kept, orientation))


def blurred(photos: list[Photo]) -> list[Photo]:
    """Photos that have far less fine detail than the others of the same lens."""
    values = [sharpness(photo.grey(), photo.mask) for photo in photos]
    of_lens = defaultdict[int, list[float]](list)
    for photo, value in zip(photos, values, strict=True):
        of_lens[photo.lens].append(value)
    usual = {lens: np.median(sharp) for lens, sharp in of_lens.items()}
    return [photo for photo, value in zip(photos, values, strict=True) if value < _BLURRED * usual[photo.lens]]


def sharpness(grey: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> float:
    """How much of the contrast is fine: standard deviation of the Laplacian over that of the smoothed brightness.

    With a mask, where no pixel that it leaves out has a part in the means.
    """
    values = grey.astype(np.float32)
    fine = cv2.Laplacian(values, cv2.CV_32F)
    smooth = cv2.GaussianBlur(values, (_KERNEL, _KERNEL), 4.0)
    if mask is not None:
        inner = cv2.erode(mask, np.ones((_KERNEL, _KERNEL), np.uint8)) > 0
        if inner.any():
            fine, smooth = fine[inner], smooth[inner]
    return float(fine.std() / (smooth.std() + 1.0))


def by_shape(photos: list[OpenPhoto]) -> dict[str, list[OpenPhoto]]:
    """The photos by their shape, as "4032x3024", that of the first of each group. Upright and lying are one."""
    groups: dict[tuple[int, int], list[OpenPhoto]] = defaultdict(list)
    for photo in photos:
        known = (size for size in groups if _same_shape(size, photo.size))
        groups[next(known, photo.size)].append(photo)
    return {f"{width}x{height}": group for (width, height), group in groups.items()}


def unlike_others(photos: list[OpenPhoto]) -> dict[str, str]:
    """Photos that are copies, or that have another shape than most and an unknown focal length, and why.

    Raises:
        PhotosRefused: most photos are panoramas, there are fewer than `MIN_PHOTOS` without copies, or no shape is that
            of most.
    """
    panoramas = [photo.path for photo in photos if photo.is_panorama]
    if 2 * len(panoramas) > len(photos):
        line = f'ffmpeg -i "{panoramas[0].name}" -vf v360=e:rectilinear:h_fov=90:v_fov=67:yaw=0 yaw_0.jpg'
        advice = f"cut some from it: `{line}`, the same for other angles"
        raise PhotosRefused(panoramas[0], "", "a picture of a lens", "a panorama", advice=advice)
    first = {photo.sha256: photo for photo in reversed(photos)}
    copies = [photo for photo in photos if photo is not first[photo.sha256]]
    if copies and len(first) < MIN_PHOTOS:
        advice = "two copies show no depth. Remove one, and take another photo from a step to the side"
        expected = f"another photo than {first[copies[0].sha256].name}"
        raise PhotosRefused(copies[0].path, "", expected, "the same", advice=advice)
    shapes = by_shape([photo for photo in photos if photo is first[photo.sha256]])
    usual = max(shapes, key=lambda shape: len(shapes[shape]))
    others = {
        photo.name: f"its shape is {shape}, not {usual}, and no Exif says its focal length: is it cropped?"
        for shape, group in shapes.items()
        for photo in group
        if shape != usual and not photo.focal_ratio
    }
    counts = sorted(map(len, shapes.values()), reverse=True)
    if others and (counts[0] < MIN_PHOTOS or counts[0] == counts[1]):
        groups = "; ".join(f"{shape}: {listed_files([p.path for p in group])}" for shape, group in shapes.items())
        advice = "keep one group in the folder. Cropped photos do not fit those that are whole"
        folder = photos[0].path.parent
        raise PhotosRefused(folder, "", "photos of one shape", f"{len(shapes)} ({groups})", advice=advice)
    return {photo.name: f"it is the same photo as {first[photo.sha256].name}" for photo in copies} | others


def _lens_numbers(photos: list[OpenPhoto]) -> dict[str, int]:
    """The number of each photo's lens by its name. Lens 0 took most.

    Photos of each shape have lenses of their own, one for each focal length of the Exif: those that differ by at most
    10 % are one. The first of them took also those whose Exif says none.
    """
    lenses = list[list[OpenPhoto]]()
    for group in by_shape(photos).values():
        zooms = list[list[OpenPhoto]]()
        shortest = 0.0
        for ratio, photo in sorted(((p.focal_ratio, p) for p in group if p.focal_ratio), key=lambda pair: pair[0]):
            if ratio > _SAME_ZOOM * shortest:
                shortest = ratio
                zooms.append([])
            zooms[-1].append(photo)
        first, *others = sorted(zooms, key=len, reverse=True) or [[]]
        lenses += [[*first, *(photo for photo in group if not photo.focal_ratio)], *others]
    lenses.sort(key=len, reverse=True)
    return {photo.name: number for number, lens in enumerate(lenses) for photo in lens}


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return Intrinsics(max(one), min(one), 1, 1, 0, 0).same_aspect(max(other), min(other))
