"""What the paper prints for our methods, to be set beside our figures.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: its comparisons on LLFF, Mip-NeRF 360 and Blender, and its ablations on LLFF with three views.

These are means over 8 scenes (Mip-NeRF 360: 7) at 504x378 (Blender: 400x400, Mip-NeRF 360: an eighth a side) after
10 000 steps, the best of five runs. They compare with ours in direction, not in level.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["PAPER", "TABLES", "Figures", "benchmark_of", "published", "published_differences"]

PAPER = "progressive 0.2"
_SCENES = {
    "LLFF": ("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"),
    "Mip-NeRF 360": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    "Blender": ("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
}


class Figures(NamedTuple):
    """One line of a printed table; LPIPS is that of unscaled inputs."""

    psnr: float
    ssim: float
    lpips: float


# Benchmark and views to the printed tables, the main comparison first. The rate of 0.2 that grows is printed with two
# values for three views of LLFF, and the text has one for Mip-NeRF 360 that no table has. The paper does not say which
# Gaussians "selective by gradient" and "by distance" drop, nor what its L1 penalties weigh: our variants of each stand
# beside the same printed line.
TABLES: dict[tuple[str, int], dict[str, dict[str, Figures]]] = {
    ("LLFF", 3): {
        "comparison": {"off": Figures(19.22, 0.649, 0.229), PAPER: Figures(20.76, 0.713, 0.200)},
        "rate and schedule": {
            "off": Figures(19.22, 0.649, 0.229),
            "fixed 0.1": Figures(20.28, 0.701, 0.209),
            "fixed 0.2": Figures(20.16, 0.700, 0.216),
            "fixed 0.3": Figures(20.15, 0.691, 0.223),
            "progressive 0.1": Figures(20.29, 0.702, 0.206),
            PAPER: Figures(20.56, 0.708, 0.207),
            "progressive 0.3": Figures(20.48, 0.707, 0.212),
        },
        "selection": {
            PAPER: Figures(20.76, 0.713, 0.200),
            **dict.fromkeys(("high gradient", "low gradient"), Figures(19.62, 0.682, 0.214)),
            **dict.fromkeys(("near", "far"), Figures(17.49, 0.582, 0.273)),
        },
        "L1": {
            PAPER: Figures(20.76, 0.713, 0.200),
            **dict.fromkeys(("L1 gradient 0.001", "L1 gradient 0.01"), Figures(19.97, 0.690, 0.211)),
            **dict.fromkeys(("L1 distance 0.001", "L1 distance 0.01"), Figures(19.73, 0.681, 0.213)),
        },
    },
    ("LLFF", 6): {"comparison": {"off": Figures(23.80, 0.814, 0.125), PAPER: Figures(24.74, 0.837, 0.117)}},
    ("LLFF", 9): {"comparison": {"off": Figures(25.44, 0.860, 0.096), PAPER: Figures(26.21, 0.874, 0.088)}},
    ("Mip-NeRF 360", 12): {"comparison": {"off": Figures(18.52, 0.523, 0.415), PAPER: Figures(19.74, 0.577, 0.364)}},
    ("Mip-NeRF 360", 24): {
        "comparison": {"off": Figures(22.80, 0.708, 0.276), PAPER: Figures(24.13, 0.762, 0.225)},
        "text": {PAPER: Figures(23.92, 0.755, 0.242)},
    },
    ("Blender", 8): {"comparison": {"off": Figures(21.56, 0.847, 0.130), PAPER: Figures(25.42, 0.888, 0.089)}},
}


def benchmark_of(scene: str, views: int) -> str | None:
    """The paper's benchmark that has a scene with so many views, whatever the layout of its folder; None: no such."""
    name = scene.rpartition("/")[2]
    return next((b for b, names in _SCENES.items() if name in names and (b, views) in TABLES), None)


def published(benchmark: str | None, views: int, method: str) -> tuple[Figures, ...]:
    """All different values that the paper prints for a method, the main comparison's first; none where it has none."""
    tables = _tables(benchmark, views)
    return tuple(dict.fromkeys(table[method] for table in tables if method in table))


def published_differences(benchmark: str | None, views: int, method: str, base: str) -> tuple[float, ...]:
    """PSNR of a method less that of another in each table that has the first, in dB, each value once.

    A table that lacks the other takes it from the first that has it. Where none has it there is no difference.
    """
    tables = _tables(benchmark, views)
    bases = published(benchmark, views, base)
    if not bases:
        return ()
    differences = [table[method].psnr - table.get(base, bases[0]).psnr for table in tables if method in table]
    return tuple(dict.fromkeys(round(difference, 2) for difference in differences))


def _tables(benchmark: str | None, views: int) -> list[dict[str, Figures]]:
    return [] if benchmark is None else list(TABLES.get((benchmark, views), {}).values())
