"""Count the files that the calls of one `kgs fit` enter with a configuration, a scene or a fit among their arguments.

    python walk.py

It fits a small scene (Blender's layout, made from the built-in orbit) in a temporary folder and prints, for each class,
the number of files whose functions were called with an instance of it, and how often the walk came back to a file that
it had left.
"""

import contextlib
import json
import math
import os
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
import torch

import kgs
from kgs.datasets import synthetic_scene

CLASSES = ("FitConfig", "Recipe", "Scene", "Plan", "SceneRequest", "Trainer", "Fit", "Finished", "SavedFit", "Start")
ROOT = Path(kgs.__file__).parents[1]


class Walk:
    """Files in the order in which calls enter them with an instance of one class in hand."""

    def __init__(self) -> None:
        self.rooms: dict[str, list[str]] = defaultdict(list)

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Note the file of a function of kgs that is called with an instance of a class of `CLASSES`."""
        path = Path(frame.f_code.co_filename)
        if event != "call" or not path.is_relative_to(ROOT) or path.parent.name == "house":
            return
        code = frame.f_code
        count = code.co_argcount + code.co_kwonlyargcount
        kinds = {type(frame.f_locals.get(name)).__name__ for name in code.co_varnames[:count]}
        for kind in kinds.intersection(CLASSES):
            rooms = self.rooms[kind]
            room = path.relative_to(ROOT).as_posix()
            if not rooms or rooms[-1] != room:
                rooms.append(room)


def write_scene(root: Path) -> None:
    """A scene of a few small pictures in Blender's layout."""
    scene = synthetic_scene("orbit", train_views=5, test_views=1, size=(72, 80), seed=0)
    for split, views in (("train", scene.train), ("test", scene.test)):
        (root / split).mkdir(parents=True)
        frames = []
        for i, image in enumerate(views.images):
            pixels = (image * 255).round().byte().permute(1, 2, 0).numpy()
            rgba = np.dstack([pixels[:, :, ::-1], np.full(pixels.shape[:2], 255, np.uint8)])
            cv2.imwrite(str(root / split / f"r_{i}.png"), rgba)
            pose = torch.linalg.inv(views.cameras.extrinsics[i].double()).numpy() @ np.diag([1.0, -1, -1, 1])
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        width = views.images.shape[-1]
        angle = 2 * math.atan(width / 2 / float(views.cameras.fx[0]))
        content = {"camera_angle_x": angle, "frames": frames}
        (root / f"transforms_{split}.json").write_text(json.dumps(content))


def main() -> None:
    """Fit, and print the table."""
    from kgs.app.cli import main as command

    walk = Walk()
    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere:
        scene = Path(folder) / "scene"
        write_scene(scene)
        words = ["fit", str(scene), "-o", str(Path(folder) / "out"), "--steps", "40"]
        for profiler in (None, walk):  # the first fit compiles the kernels
            with contextlib.suppress(SystemExit), contextlib.redirect_stdout(nowhere):
                sys.setprofile(profiler)
                command(words)
            sys.setprofile(None)
        if not (Path(folder) / "out" / "metrics.json").is_file():
            raise SystemExit("the fit was not finished")
    print("| in hand | files | returns |\n|---|---|---|")
    for kind in CLASSES:
        if rooms := walk.rooms.get(kind):
            print(f"| {kind} | {len(set(rooms))} | {len(rooms) - len(set(rooms))} |")
    if "--files" in sys.argv:
        for kind, rooms in walk.rooms.items():
            print(kind, *sorted(set(rooms)), sep="\n  ")


if __name__ == "__main__":
    main()
