"""Colours of a photo whose file says that they are not sRGB (the Display P3 of phones, Adobe RGB), converted to sRGB.

What a file says is an ICC profile, or primaries, a white point and a curve. Sources: ITU-T H.273 for the numbers of
cICP and nclx; Adobe RGB (1998) Color Image Encoding; W3C, Portable Network Graphics (third edition), 4.3 for the order
in which the chunks of a PNG count; IEC 61966-2-1 (sRGB).
"""

import io
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageCms

from kgs._support.errors import ArgumentError

_SRGB = ImageCms.createProfile("sRGB")
_SAME = 3  # levels of 255: a profile that changes no colour by more than this is sRGB under another name
_PROBE = np.stack(np.meshgrid(*[np.linspace(0, 255, 9).round()] * 3, indexing="ij"), axis=-1).astype(np.uint8)
_MODES = {"RGB": "RGB", "GRAY": "L"}  # those of Pillow by the space of a profile
_USUAL_GAMMA = 2.2
_SAME_GAMMA = 0.05  # relative; what is this close to 2.2 means sRGB's curve if the primaries are its, as libpng has it
_SAME_CHROMATICITY = 0.003
_ROWS = 256  # that are converted at once: what is needed for more takes memory
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_D65 = (0.3127, 0.3290)
_BT709 = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
_SMPTE = ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070))
# Primaries and white by their number in H.273; 2 is "unspecified", and 0, which is reserved, is taken for it.
_PRIMARIES = {
    0: (_BT709, _D65),
    1: (_BT709, _D65),
    2: (_BT709, _D65),
    5: (((0.64, 0.33), (0.29, 0.60), (0.15, 0.06)), _D65),
    6: (_SMPTE, _D65),
    7: (_SMPTE, _D65),
    9: (((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)), _D65),
    12: (((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)), _D65),
}
# Exponents by the number of the curve, None for sRGB's, for which viewers take the camera curves of BT.601, 709 and
# 2020, too.
_GAMMAS = {0: None, 1: None, 2: None, 4: 2.2, 5: 2.8, 6: None, 8: 1.0, 13: None, 14: None, 15: None}
_HDR = {16: "PQ", 18: "HLG"}


class Colors(NamedTuple):
    """Colours that primaries, a white point (CIE 1931 x and y) and a curve describe."""

    primaries: tuple[tuple[float, float], ...] = _BT709  # of red, green and blue
    white: tuple[float, float] = _D65
    gamma: float | None = None  # exponent of the light over the value; None: sRGB's curve

    @classmethod
    def of(cls, white: Any, primaries: Any, gamma: Any = None) -> Self | None:
        """Those of a file's numbers: x and y of white, and of red, green and blue; None where they are damaged."""
        try:
            numbers = [float(number) for number in (*white, *primaries, gamma or 1)]
            chromaticities = tuple(zip(numbers[:8:2], numbers[1:8:2], strict=True))
            described = cls(chromaticities[1:], chromaticities[0], numbers[8] if gamma else None)
            matrix = _to_xyz(described.primaries, described.white)
        except (TypeError, ValueError, ArithmeticError, IndexError, np.linalg.LinAlgError):
            return None
        return described if np.isfinite([*numbers, *matrix.flat]).all() and numbers[8] > 0 else None

    @property
    def is_srgb(self) -> bool:
        """Whether they are sRGB, or nearly so."""
        differences = np.abs(np.subtract([*self.primaries, self.white], [*_BT709, _D65]))
        gamma = self.gamma or _USUAL_GAMMA
        return bool(differences.max() <= _SAME_CHROMATICITY and abs(gamma / _USUAL_GAMMA - 1) <= _SAME_GAMMA)


ADOBE_RGB = Colors(((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)), _D65, 563 / 256)
Profile = bytes | Colors  # the bytes of an ICC profile, empty where nothing is said


def colors_of(primaries: int, curve: int) -> Colors:
    """The colours that two numbers of H.273 stand for; a ValueError where they cannot be converted to sRGB."""
    if curve in _HDR:
        raise ArgumentError("colours", "those of standard range", f"HDR ({_HDR[curve]})", advice="save it as a JPEG")
    if primaries not in _PRIMARIES or curve not in _GAMMAS:
        raise ArgumentError("colours", "known ones", f"primaries {primaries} and curve {curve} of H.273")
    return Colors(*_PRIMARIES[primaries], _GAMMAS[curve])


def to_srgb(image: NDArray[np.float32], profile: Profile) -> NDArray[np.float32]:
    """An image in sRGB, which is what kgs takes all images for.

    Args:
        image: `(H, W, 3)` RGB or `(H, W, 4)` RGBA in [0, 1].
        profile: what the file says of the colours.

    Returns:
        The image in sRGB, of an ICC profile in steps of 1/255. The image itself where there is no profile, where its
        colours are sRGB already, and where :func:`is_usable` says that the profile is not.
    """
    if isinstance(profile, Colors):
        return image if profile.is_srgb else _from_primaries(image, profile)
    transform = _transform(profile) if profile else None
    if transform is None or not transform.moves:
        return image
    levels = (image[..., :3] * 255).round().astype(np.uint8)
    if transform.mode == "L":
        if (levels != levels[..., :1]).any():  # a profile of grey in an image of colours
            return image
        levels = levels[..., 0]
    converted = image.copy()
    converted[..., :3] = _apply(transform.transform, levels) / np.float32(255)
    return converted


def is_usable(profile: Profile) -> bool:
    """Whether a profile can be used: it is none, or not damaged, and one of RGB, grey or CMYK."""
    return isinstance(profile, Colors) or not profile or _transform(profile) is not None or _cmyk(profile) is not None


def cmyk_to_rgb(image: PIL.Image.Image, profile: bytes) -> PIL.Image.Image:
    """A CMYK image of Pillow in sRGB, by its profile if that is one of CMYK."""
    transform = _cmyk(profile) if profile else None
    return image.convert("RGB") if transform is None else transform.apply(image)


class _Transform(NamedTuple):
    """What turns 8-bit colours of a profile into sRGB."""

    transform: ImageCms.ImageCmsTransform
    mode: str  # "RGB", or "L" for grey
    moves: bool  # whether it changes any colour


@lru_cache(maxsize=4)  # the photos of a scene have one or two profiles
def _transform(profile: bytes) -> _Transform | None:
    """None where a profile is damaged, or not one of RGB or grey."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        mode = _MODES.get(source.profile.xcolor_space.strip())
        if mode is None:
            return None
        transform = _build(source, mode)
    except (OSError, ImageCms.PyCMSError):  # as other damaged metadata
        return None
    probe = _PROBE.reshape(27, 27, 3)
    if mode == "L":
        probe = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    moved = np.abs(_apply(transform, probe if mode == "RGB" else probe[..., 0]).astype(int) - probe).max()
    return _Transform(transform, mode, bool(moved > _SAME))


@lru_cache(maxsize=4)
def _cmyk(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """None where a profile is damaged, or not one of CMYK."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        return _build(source, "CMYK") if source.profile.xcolor_space.strip() == "CMYK" else None
    except (OSError, ImageCms.PyCMSError):
        return None


def _build(source: ImageCms.ImageCmsProfile, mode: str) -> ImageCms.ImageCmsTransform:
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    return ImageCms.buildTransform(source, _SRGB, mode, "RGB", renderingIntent=intent)


def _apply(transform: ImageCms.ImageCmsTransform, levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(transform.apply(PIL.Image.fromarray(np.ascontiguousarray(levels))))


def _from_primaries(image: NDArray[np.float32], colors: Colors) -> NDArray[np.float32]:
    """An image of these colours in sRGB; what sRGB has no numbers for is clipped."""
    matrix = np.linalg.inv(_to_xyz(_BT709, _D65)) @ _adaptation(colors.white) @ _to_xyz(colors.primaries, colors.white)
    converted = image.copy()
    for rows in np.array_split(converted, range(_ROWS, len(converted), _ROWS)):  # views
        rows[..., :3] = _encoded(rows[..., :3], colors.gamma, matrix.astype(np.float32))
    return converted


def _encoded(values: NDArray[np.float32], gamma: float | None, matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """The numbers of sRGB for those of a space with this curve, whose light is turned into sRGB's by a matrix."""
    if gamma is None:
        light = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    else:
        light = values**gamma
    light = np.clip(light @ matrix.T, 0, 1)
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)


def _to_xyz(primaries: tuple[tuple[float, float], ...], white: tuple[float, float]) -> NDArray[np.float64]:
    """The matrix from linear RGB to XYZ; white has Y = 1."""
    columns = np.stack([_xyz(primary) for primary in primaries], axis=1)
    return np.asarray(columns * np.linalg.solve(columns, _xyz(white)))


def _adaptation(white: tuple[float, float]) -> NDArray[np.float64]:
    """The matrix that moves a white point to that of sRGB (Bradford)."""
    ratio = (_BRADFORD @ _xyz(_D65)) / (_BRADFORD @ _xyz(white))
    return np.asarray(np.linalg.inv(_BRADFORD) @ np.diag(ratio) @ _BRADFORD)


def _xyz(chromaticity: tuple[float, float]) -> NDArray[np.float64]:
    x, y = chromaticity
    return np.array([x / y, 1.0, (1 - x - y) / y])
