"""The scenes of `kgs demo`, written as `kgs fit` leaves one that it made: photos, their cameras and a report."""

import shutil
from pathlib import Path
from typing import Any

import torch
from kornia.geometry import camtoworld_vision_to_graphics_4x4

from kgs._support.json_files import read_json, write_json
from kgs.app.files.outputs import write_png
from kgs.datasets import synthetic_scene
from kgs.datasets.folders import CAMERAS_REPORT, LAYOUTS

PHOTOS = Path(__file__).parent / "demo_photos"  # six training photos, two held out, and their cameras
CREDIT = "Photos: Piero Toffanin, dataset_banana (MIT licence)."
SIDE = 504  # pixels of the longer side, of the photos and by default of the room
_SHAPE = 3 / 4  # height of the room's pictures, relative to their width


def write_bananas(folder: Path) -> None:
    """Write the photos of the package and their cameras to a folder."""
    content = read_json(PHOTOS / LAYOUTS["nerfstudio"].file)
    images = folder / "images"
    images.mkdir(exist_ok=True)
    for path in (*PHOTOS.glob("*.jpg"), PHOTOS / "LICENSE"):
        shutil.copyfile(path, images / path.name)
    for key in ("train_filenames", "test_filenames"):
        content[key] = [f"images/{name}" for name in content[key]]
    for frame in content["frames"]:
        frame["file_path"] = f"images/{frame['file_path']}"
    write_json(folder / LAYOUTS["nerfstudio"].file, content)
    write_json(folder / CAMERAS_REPORT, {"origin": CREDIT, "poses": "found by kgs from all eight photos"})


def write_room(folder: Path, side: int, seed: int) -> None:
    """Draw the synthetic room, `side` pixels wide, from three training and three held-out cameras."""
    height = round(_SHAPE * side)
    scene = synthetic_scene(train_views=3, test_views=3, size=(height, side), seed=seed)
    (folder / "images").mkdir(exist_ok=True)
    frames = list[dict[str, Any]]()
    for views in (scene.train, scene.test):
        poses = camtoworld_vision_to_graphics_4x4(torch.linalg.inv(views.cameras.extrinsics.double()))
        for name, image, pose in zip(views.names, views.images, poses, strict=True):
            frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
            write_png(folder / "images" / f"{name}.png", image)
    names = [frame["file_path"] for frame in frames]
    matrix = scene.train.cameras.intrinsics[0]
    content = {
        "w": side,
        "h": height,
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]) + 0.5,  # the first pixel's centre is at 0.5 here
        "cy": float(matrix[1, 2]) + 0.5,
        "train_filenames": names[: len(scene.train)],
        "test_filenames": names[len(scene.train) :],
        "frames": frames,
    }
    write_json(folder / LAYOUTS["nerfstudio"].file, content)
    write_json(folder / CAMERAS_REPORT, {"origin": "A synthetic room.", "poses": "known exactly"})
