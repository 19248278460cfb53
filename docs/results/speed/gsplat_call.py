"""What `kgs.rasterization` costs on this machine beside the renderer, and its options beside the plain call.

    python docs/results/speed/gsplat_call.py

prints the table of docs/gsplat.md: a forward and backward pass of the scene of `kgs bench speed`, in turn.
"""

import math
from functools import partial
from typing import Any

import torch

from kgs._support.machine import versions
from kgs.bench.output import markdown_table
from kgs.bench.speed import SIZE, Cases
from kgs.bench.timing import Case, take_turns
from kgs.gsplat import rasterization

COUNTS = (10_000, 50_000)
OPTIONS: dict[str, dict[str, Any]] = {
    "kgs.rasterization": {},
    "packed=False": {"packed": False},
    "absgrad=True": {"absgrad": True},
    'rasterize_mode="antialiased"': {"rasterize_mode": "antialiased"},
    "far_plane, radius_clip": {"far_plane": 100.0, "radius_clip": 1.0},
    'render_mode="RGB+ED"': {"render_mode": "RGB+ED"},
}


def cases(count: int) -> dict[str, Case]:
    """The renderer and the calls on one scene."""
    scene = Cases(count, SIZE, torch.device("cpu"))
    height, width = SIZE

    def call(**options: Any) -> None:
        gaussians = scene.model()
        renders, _, _ = rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            gaussians.colors,
            scene.camera.extrinsics,
            scene.camera.intrinsics[:, :3, :3],
            width,
            height,
            sh_degree=math.isqrt(gaussians.colors.shape[1]) - 1,
            pixel_centers="integer",
            **options,
        )
        (renders[..., :3] * scene.weights.permute(0, 2, 3, 1)).sum().backward()
        scene.model.zero_grad()

    calls = {name: partial(call, **options) for name, options in OPTIONS.items()}
    return {"GaussianRenderer": scene.both, **calls}


def main(repeats: int = 7) -> None:
    """Print the table: milliseconds, medians."""
    columns = {count: take_turns(cases(count), repeats, torch.device("cpu")) for count in COUNTS}
    names = list(columns[COUNTS[0]])
    cells = [[name, *(f"{1e3 * columns[count][name].wall:.0f} ms" for count in COUNTS)] for name in names]
    title = f"Forward and backward pass at {SIZE[1]}x{SIZE[0]}, {versions()['machine']}, medians of {repeats}"
    print(markdown_table(title, [f"{count} Gaussians" for count in COUNTS], cells, ""))


if __name__ == "__main__":
    main()
