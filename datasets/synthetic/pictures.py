"""Pictures that hang or lie in the synthetic room, and titles on the spines of its books: drawn with OpenCV.

Colours are RGB in 0 to 255, as OpenCV draws them; a picture is `(rows, columns, 3)`, uint8, its first row on top.
"""

from colorsys import hsv_to_rgb

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Color = tuple[float, float, float]
DENSITY = 700.0  # pixels of a picture per metre: three to four for each pixel of a default photo
_FONT = cv2.FONT_HERSHEY_DUPLEX


def blank(width: float, height: float, color: Color) -> Picture:
    """A picture in one colour, its size in metres."""
    return np.full((round(height * DENSITY), round(width * DENSITY), 3), color, dtype=np.uint8)


def tone(hue: float, saturation: float, value: float) -> Color:
    """The colour of a hue (0 red, 1/3 green, 2/3 blue), all in [0, 1]."""
    red, green, blue = hsv_to_rgb(hue % 1.0, saturation, value)
    return 255 * red, 255 * green, 255 * blue


def spine(title: str, length: float, thickness: float, cover: Color, ink: Color) -> Picture:
    """A book's spine as it lies: the title from left to right between two bands."""
    picture = blank(length, thickness, cover)
    rows, columns = picture.shape[:2]
    band = max(2, columns // 40)
    for left in (columns // 16, columns - columns // 16 - band):
        picture[:, left : left + band] = ink
    (width, height), _ = cv2.getTextSize(title, _FONT, 1.0, 2)
    scale = min(0.76 * columns / width, 0.62 * rows / height)
    origin = round((columns - scale * width) / 2), round((rows + scale * height) / 2)
    cv2.putText(picture, title, origin, _FONT, scale, ink, max(2, round(2.2 * scale)), cv2.LINE_AA)
    return picture


def landscape(rng: np.random.Generator, width: float, height: float) -> Picture:
    """An evening: the sun over three ranges of mountains, the nearest one the darkest."""
    picture = _fade(width, height, (250, 184, 107), (252, 230, 178))
    rows, columns = picture.shape[:2]
    sun = round(rng.uniform(0.3, 0.7) * columns), round(0.36 * rows)
    cv2.circle(picture, sun, round(0.13 * rows), (237, 92, 51), cv2.FILLED, cv2.LINE_AA)
    for base, color in ((0.5, (158, 140, 168)), (0.66, (76, 107, 143)), (0.83, (31, 61, 87))):
        _ridge(picture, rng, base, 0.14, color)
    return picture


def outlook(rng: np.random.Generator, width: float, height: float) -> Picture:
    """What is seen through the window: clouds over hills and trees."""
    picture = _fade(width, height, (107, 173, 237), (204, 232, 247))
    rows, columns = picture.shape[:2]
    for x in (0.2, 0.75):
        for shift in (-0.1, 0.0, 0.1):
            axes = round(0.13 * columns), round(0.055 * rows)
            center = round((x + shift) * columns), round((rng.uniform(0.2, 0.26) + 0.2 * x) * rows)
            cv2.ellipse(picture, center, axes, 0, 0, 360, (255, 255, 255), cv2.FILLED, cv2.LINE_AA)
    _ridge(picture, rng, 0.68, 0.06, (140, 186, 115))
    _ridge(picture, rng, 0.82, 0.05, (97, 153, 76))
    for x in rng.uniform(0.1, 0.9, size=3):
        crown = round(x * columns), round(0.7 * rows)
        cv2.line(picture, crown, (crown[0], round(0.86 * rows)), (92, 61, 38), 8, cv2.LINE_AA)
        cv2.circle(picture, crown, round(rng.uniform(0.08, 0.12) * rows), (51, 115, 51), cv2.FILLED, cv2.LINE_AA)
    return picture


def rug(rng: np.random.Generator, width: float, height: float) -> Picture:
    """A woven rug: borders around rows of diamonds."""
    hue = rng.choice([0.0, 0.56, 0.95])
    ground = tone(hue, 0.7, 0.6)
    light = (237, 219, 184)
    dark = tone(hue + 0.55, 0.5, 0.35)
    picture = blank(width, height, ground)
    rows, columns = picture.shape[:2]
    for inset, color in ((0.02, light), (0.04, dark), (0.09, light), (0.11, ground)):
        gap = round(inset * columns)
        picture[gap : rows - gap, gap : columns - gap] = color
    for x in np.linspace(0.18, 0.82, 7) * columns:
        for y in np.linspace(0.3, 0.7, 3) * rows:
            for size, color in ((0.055, light), (0.036, dark), (0.016, light)):
                half = size * columns
                corners = np.array([[x - half, y], [x, y - half], [x + half, y], [x, y + half]])
                cv2.fillPoly(picture, [corners.round().astype(np.int32)], color, cv2.LINE_AA)
    return picture


def _fade(width: float, height: float, top: Color, bottom: Color) -> Picture:
    share = np.linspace(0.0, 1.0, round(height * DENSITY), dtype=np.float32)[:, None, None]
    mixed = blank(width, height, top) * (1 - share) + blank(width, height, bottom) * share
    return mixed.round().astype(np.uint8)


def _ridge(picture: Picture, rng: np.random.Generator, base: float, swing: float, color: Color) -> None:
    """Fill the picture below a line of hills; `base` and `swing` are shares of the height, from the top."""
    rows, columns = picture.shape[:2]
    x = np.linspace(0.0, 1.0, columns)
    waves = sum(np.sin(2 * np.pi * (k * x + rng.uniform())) / k for k in (1.3, 2.9, 5.7))
    heights = base - 0.6 * swing * waves
    picture[np.arange(rows)[:, None] >= heights * rows] = color
