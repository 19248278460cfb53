"""What has to be measured on a card, in about ten minutes: `python card.py [--fit SCENE]`, markdown on stdout.

The first use with an empty cache and in a second process; forward and backward passes and training steps of kgs and,
where its CUDA kernels are there, of gsplat, in turn; and a fit of three photos of a scene. Run `pytest -m cuda` and
`kgs check` beside it. `--device cpu --counts 1000` tries the script itself.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import torch

from kgs._support.machine import device_name, versions
from kgs.bench.output import markdown_table
from kgs.bench.speed import Cases
from kgs.bench.timing import Case, take_turns

SIZES = {10_000: (378, 504), 50_000: (378, 504), 200_000: (378, 504), 1_000_000: (1080, 1920), 3_000_000: (1080, 1920)}
REPEATS = 30
CHECK = "import sys, torch, kgs.backends as b; print(b.get_backend('auto', torch.device(sys.argv[1])).name)"


def first_uses(device: str) -> list[str]:
    """Seconds of two processes that check the kernels, the first with an empty cache."""
    lines = []
    with tempfile.TemporaryDirectory() as cache:
        for name in ("empty cache", "second process"):
            start = time.perf_counter()
            taken = output([sys.executable, "-c", CHECK, device], TRITON_CACHE_DIR=cache).strip()
            lines.append(f"- {name}: {time.perf_counter() - start:.1f} s, takes {taken}")
    return lines


def cases(count: int, device: torch.device) -> dict[str, Case]:
    """What is timed of a scene."""
    scene = Cases(count, SIZES.get(count, (48, 64)), device)
    found: dict[str, Case] = {
        "kgs, forward": scene.forward,
        "kgs, forward + backward": scene.both,
        "kgs, training step": scene.train,
    }
    if has_gsplat(device):
        found["gsplat, forward + backward"] = partial(by_gsplat, scene)
    return found


def has_gsplat(device: torch.device) -> bool:
    """Whether gsplat and its kernels are there."""
    if device.type != "cuda":
        return False
    try:
        from gsplat.cuda._backend import _C
    except ImportError:
        return False
    return _C is not None


def by_gsplat(scene: Cases) -> None:
    """The same pass by gsplat."""
    from gsplat import rasterization

    height, width = scene.weights.shape[-2:]
    gaussians = scene.model()
    matrix = scene.camera.intrinsics[:, :3, :3].clone()
    matrix[:, :2, 2] += 0.5  # gsplat's centre of the first pixel
    degree = math.isqrt(gaussians.colors.shape[1]) - 1
    values = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    image, _, _ = rasterization(*values, scene.camera.extrinsics, matrix, width, height, sh_degree=degree, packed=False)
    (image * scene.weights.permute(0, 2, 3, 1)).sum().backward()
    scene.model.zero_grad()


def output(command: list[str], **environment: str) -> str:
    """What a program prints; its errors are shown."""
    done = subprocess.run(command, env=os.environ | environment, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--counts", nargs="+", type=int, default=list(SIZES), metavar="N")
    parser.add_argument("--fit", type=Path, metavar="SCENE")
    given = parser.parse_args()
    device = torch.device(given.device)
    print(f"{device_name(device)}; {versions()}\n")
    print("\n".join(first_uses(given.device)))
    for count in given.counts:
        times = take_turns(cases(count, device), REPEATS, device)
        cells = [[name, *(f"{1e3 * x:.2f}" for x in (t.wall, t.best, t.worst))] for name, t in times.items()]
        print(markdown_table(f"{count} Gaussians, ms", ["median", "least", "largest"], cells, ""), flush=True)
    if given.fit is not None:
        with tempfile.TemporaryDirectory() as out:
            start = time.perf_counter()
            print(output(["kgs", "fit", str(given.fit), "--views", "3", "--device", given.device, "-o", out]))
            print(f"kgs fit: {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    main()
