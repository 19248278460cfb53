"""Makes film.webp of the demo: the six photos that it fits, and beside them its film.

python docs/pictures/film.py DEMO
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

PHOTOS = 438, 423, 425, 426, 428, 429  # of the training, in the order of the arc
FRAME = 480, 320  # of the film; three photos below each other are as high
GAP = 4  # white pixels between the pictures
EVERY = 2  # frames of the film
MILLISECONDS = 1000 * EVERY // 24
QUALITY = 60
FOLDER = Path(__file__).parent
DEMO_PHOTOS = FOLDER.parents[1] / "kgs" / "app" / "demo_photos"


def main(demo: Path) -> None:
    """Write film.webp from a folder of `kgs demo`."""
    height = (FRAME[1] - 2 * GAP) // 3
    width = height * 3 // 2
    still = np.full((FRAME[1], 2 * (width + GAP) + FRAME[0], 3), 255, np.uint8)
    for index, number in enumerate(PHOTOS):
        row, column = divmod(index, 2)
        top, left = row * (height + GAP), column * (width + GAP)
        photo = cv2.imread(str(DEMO_PHOTOS / f"DSC_0{number}.jpg"))
        small = cv2.resize(photo, (width, height), interpolation=cv2.INTER_AREA)
        still[top : top + height, left : left + width] = small
    (path,) = demo.glob("turntable.*")
    film, pictures = cv2.VideoCapture(str(path)), []
    while (read := film.read())[0]:
        picture = still.copy()
        picture[:, -FRAME[0] :] = cv2.resize(read[1], FRAME, interpolation=cv2.INTER_AREA)
        pictures.append(Image.fromarray(picture[..., ::-1]))
    first, *others = pictures[::EVERY]
    options = {"duration": MILLISECONDS, "loop": 0, "quality": QUALITY, "method": 6}
    first.save(FOLDER / "film.webp", save_all=True, append_images=others, **options)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
