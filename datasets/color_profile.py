"""Colours of a photo whose file has an ICC profile (the Display P3 of phones, Adobe RGB), converted to sRGB."""

import io
from functools import lru_cache

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from PIL import ImageCms

_SRGB = ImageCms.createProfile("sRGB")
_SAME = 3  # levels of 255: a profile that changes no colour by more than this is sRGB under another name
_PROBE = np.stack(np.meshgrid(*[np.linspace(0, 255, 9).round()] * 3, indexing="ij"), axis=-1).astype(np.uint8)


def to_srgb(image: NDArray[np.float32], profile: bytes) -> NDArray[np.float32]:
    """An image whose colours are those of an ICC profile in sRGB, which is what kgs takes all images for.

    Args:
        image: `(H, W, 3)` RGB or `(H, W, 4)` RGBA in [0, 1].
        profile: the bytes of the profile, empty for none.

    Returns:
        The image in sRGB, in steps of 1/255. The image itself where there is no profile, where its colours are sRGB
        already, and where the profile is damaged or not one of RGB.
    """
    transform = _transform(profile) if profile else None
    if transform is None:
        return image
    levels = (image[..., :3] * 255).round().astype(np.uint8)
    converted = image.copy()
    converted[..., :3] = _apply(transform, levels) / np.float32(255)
    return converted


@lru_cache(maxsize=4)  # the photos of a scene have one or two profiles
def _transform(profile: bytes) -> ImageCms.ImageCmsTransform | None:
    """What turns 8-bit colours of a profile into sRGB; None where nothing is to be done."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return None
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        transform = ImageCms.buildTransform(source, _SRGB, "RGB", "RGB", renderingIntent=intent)
    except (OSError, ImageCms.PyCMSError):  # as other damaged metadata
        return None
    moved = np.abs(_apply(transform, _PROBE.reshape(27, 27, 3)).astype(int) - _PROBE.reshape(27, 27, 3)).max()
    return transform if moved > _SAME else None


def _apply(transform: ImageCms.ImageCmsTransform, levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(transform.apply(PIL.Image.fromarray(np.ascontiguousarray(levels))))
