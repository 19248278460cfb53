"""Makes the photos of `kgs demo` and their cameras: python docs/pictures/demo_photos.py BANANA.

BANANA is a folder with the photos of https://github.com/pierotofy/dataset_banana (Piero Toffanin, MIT licence). Cameras
are found from all eight photos. Each photo is undistorted and reduced, and keeps neither Exif data nor the lens.
"""

import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from kornia.geometry import camtoworld_vision_to_graphics_4x4
from PIL import Image

from kgs._support.json_files import write_json
from kgs.app.files.images import eight_bits
from kgs.app.sfm import pose_photos
from kgs.datasets import load_scene

NUMBERS = 438, 423, 424, 425, 426, 427, 428, 429  # of the photos, in the order of the arc
HELD_OUT = 424, 427
SIDE = 504  # pixels of the longer side
QUALITY = 92  # of the JPEGs
FOLDER = Path(__file__).parents[2] / "kgs" / "app" / "demo_photos"


def main(dataset: Path) -> None:
    """Find the cameras, and write photos and transforms.json."""
    with TemporaryDirectory() as work:
        photos = Path(work) / "photos"
        photos.mkdir()
        for number in NUMBERS:
            shutil.copy(dataset / f"DSC_0{number}.JPG", photos)
        report = pose_photos(photos, Path(work) / "posed")
        views = load_scene(Path(work) / "posed", hold_out=0, downscale=max(report["size"]) / SIDE).train
    names = [f"{Path(name).stem}.jpg" for name in views.names]
    for name, image in zip(names, views.images, strict=True):
        picture = Image.fromarray(eight_bits(image)[..., ::-1])
        picture.save(FOLDER / name, quality=QUALITY)
    held_out = [f"DSC_0{number}.jpg" for number in HELD_OUT]
    matrix = views.cameras.intrinsics[0]
    height, width = views.images.shape[-2:]
    poses = camtoworld_vision_to_graphics_4x4(torch.linalg.inv(views.cameras.extrinsics.double()))
    content = {
        "w": width,
        "h": height,
        "fl_x": round(float(matrix[0, 0]), 4),
        "fl_y": round(float(matrix[1, 1]), 4),
        "cx": round(float(matrix[0, 2]) + 0.5, 4),  # the first pixel's centre is at 0.5 here
        "cy": round(float(matrix[1, 2]) + 0.5, 4),
        "train_filenames": [name for name in names if name not in held_out],
        "test_filenames": held_out,
        "frames": [
            {"file_path": name, "transform_matrix": [[round(value, 7) for value in row] for row in pose.tolist()]}
            for name, pose in zip(names, poses, strict=True)
        ],
    }
    write_json(FOLDER / "transforms.json", content)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
