"""Colours of a photo converted to sRGB, where its file says that they are others: the Display P3 of phones, Adobe RGB.

Sources: Adobe RGB (1998) Color Image Encoding; IEC 61966-2-1 (sRGB).
"""

import io
from functools import lru_cache

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageCms

SRGB = "sRGB"
ADOBE_RGB = "Adobe RGB"
Profile = bytes | str  # an ICC profile, or one of these names; empty where a file says nothing
_PROFILE_OF_SRGB = ImageCms.createProfile("sRGB")
_SAME = 3  # levels of 255: a profile that changes no colour by more than this is sRGB under another name
_PROBE = np.stack(np.meshgrid(*[np.linspace(0, 255, 9).round()] * 3, indexing="ij"), axis=-1).astype(np.uint8)
_PROBE = _PROBE.reshape(27, 27, 3)
_ROWS = 256  # that are converted at once: what is needed for more takes memory
_ADOBE_GAMMA = 563 / 256
# From its linear light to that of sRGB, which has the same white.
_ADOBE_TO_SRGB = np.array(
    [[1.398355743961, -0.398355743961, 0.0], [0.0, 1.0, 0.0], [0.0, -0.042928989294, 1.042928989294]], np.float32
)


def to_srgb(image: NDArray[np.float32], profile: Profile) -> NDArray[np.float32]:
    """An image in sRGB, which is what kgs takes all images for.

    Args:
        image: `(H, W, 3)` RGB or `(H, W, 4)` RGBA in [0, 1].
        profile: what the file says of the colours.

    Returns:
        The image in sRGB, of an ICC profile in steps of 1/255. The image itself where its colours are sRGB already, and
        where :func:`is_usable` says that the profile is not.
    """
    if profile == ADOBE_RGB:
        converted = image.copy()
        for rows in np.array_split(converted, range(_ROWS, len(converted), _ROWS)):  # views
            light = np.clip(rows[..., :3] ** _ADOBE_GAMMA @ _ADOBE_TO_SRGB.T, 0, 1)
            rows[..., :3] = np.where(light <= 0.0031308, light * 12.92, 1.055 * light ** (1 / 2.4) - 0.055)
        return converted
    transform = _transform(profile) if isinstance(profile, bytes) else None
    if transform is None or np.abs(_apply(transform, _PROBE).astype(int) - _PROBE).max() <= _SAME:
        return image
    converted = image.copy()
    converted[..., :3] = _apply(transform, (image[..., :3] * 255).round().astype(np.uint8)) / np.float32(255)
    return converted


def is_usable(profile: Profile) -> bool:
    """Whether a profile can be used: it is none, a name, or an undamaged one of RGB."""
    return isinstance(profile, str) or _transform(profile) is not None


@lru_cache(maxsize=4)  # the photos of a scene have one or two profiles
def _transform(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """What turns 8-bit colours of a profile into sRGB; None where it is damaged, or not one of RGB."""
    intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        return ImageCms.buildTransform(source, _PROFILE_OF_SRGB, "RGB", "RGB", renderingIntent=intent)
    except (OSError, ImageCms.PyCMSError):  # as other damaged metadata
        return None


def _apply(transform: ImageCms.ImageCmsTransform, levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(transform.apply(PIL.Image.fromarray(np.ascontiguousarray(levels))))
