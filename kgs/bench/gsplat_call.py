"""What `kgs.rasterization` costs on this machine beside the renderer, and its options beside the plain call.

    python -m kgs.bench.gsplat_call

prints a table: a forward and backward pass of the scene of `kgs bench speed`, each beside the others in turn.
"""

import math
from functools import partial
from typing import Any

import torch

from kgs.gsplat import rasterization
from kgs.machine import versions

from .output import markdown_table
from .speed import SIZE, Cases
from .timing import Case, take_turns

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
    made = Cases(count, SIZE, torch.device("cpu"))

    def call(**options: Any) -> None:
        gaussians = made.model()
        k = made.camera.intrinsics[:, :3, :3]
        given = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
        size, degree = (SIZE[1], SIZE[0]), math.isqrt(gaussians.colors.shape[1]) - 1
        views = (made.camera.extrinsics, k, *size)
        renders, _, _ = rasterization(*given, *views, sh_degree=degree, pixel_centers="integer", **options)
        (renders[..., :3] * made.weights.permute(0, 2, 3, 1)).sum().backward()
        made.model.zero_grad()

    return {"GaussianRenderer": made.both, **{name: partial(call, **options) for name, options in OPTIONS.items()}}


def main(repeats: int = 7) -> None:
    """Print the table: milliseconds, medians."""
    columns = {count: take_turns(cases(count), repeats, torch.device("cpu")) for count in COUNTS}
    names = list(columns[COUNTS[0]])
    cells = [[name, *(f"{1e3 * columns[count][name].wall:.0f} ms" for count in COUNTS)] for name in names]
    title = f"Forward and backward pass at {SIZE[1]}x{SIZE[0]}, {versions()['machine']}, medians of {repeats}"
    print(markdown_table(title, [f"{count} Gaussians" for count in COUNTS], cells, ""))


if __name__ == "__main__":
    main()
