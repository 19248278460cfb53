"""How far pictures of `run.mjs` are from the render of kgs at the same camera: `python compare.py OUT PICTURES`."""

import json
import math
import sys
from pathlib import Path

import cv2
import torch

import kgs
from kgs.app.files.images import eight_bits

out, pictures = map(Path, sys.argv[1:])
WIDTH, HEIGHT = 640, 480
entry = json.loads((out / "cameras.json").read_text())[0]
pose = torch.eye(4, dtype=torch.float64)
pose[:3, :3] = torch.tensor(entry["rotation"], dtype=torch.float64)
pose[:3, 3] = torch.tensor(entry["position"], dtype=torch.float64)
focal = HEIGHT * entry["fy"] / entry["height"]
lens = torch.tensor([[[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]]])
camera = kgs.pinhole_cameras(torch.linalg.inv(pose).float()[None], lens, WIDTH, HEIGHT, pixel_centers="half")
with torch.no_grad():
    image = kgs.GaussianRenderer()(kgs.load_ply(out / "splat.ply")(), camera, torch.zeros(3)).image[0]
expected = eight_bits(image).astype(float)
for path in sorted(pictures.glob("*-camera.png")):
    off = cv2.imread(str(path)) - expected
    level, mean = 20 * math.log10(255) - 10 * math.log10((off**2).mean()), off.mean()
    print(f"{path.stem.removesuffix('-camera')}: {level:.1f} dB, mean difference {mean:+.1f} of 255")
