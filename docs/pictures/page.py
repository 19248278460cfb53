"""Draws the first window of a page in Chromium.

PYTHONPATH=tests/helpers python docs/pictures/page.py DEMO/index.html
"""

import base64
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from browser import Browser

WINDOW = 1280, 800  # CSS pixels, width and height
READY = "document.querySelector('.viewer').dataset.state === 'ready'"
FOLDER = Path(__file__).parent


def main(page: str) -> None:
    """Write page.jpg."""
    with TemporaryDirectory() as profile, Browser(Path(profile)) as browser:
        browser.size(*WINDOW)
        browser.open(Path(page), READY)
        data = browser.call("Page.captureScreenshot", format="png")["data"]
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(FOLDER / "page.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main(sys.argv[1])
