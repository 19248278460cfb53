"""Made-up cells of the study, and Student's quantile."""

import random

from scipy import stats

from kgs.study.presets import METHODS

TINY = {"steps": 3, "max_gaussians": 400, "evaluations": 1}
MAIN = ("off", "progressive 0.2", "fixed 0.1")
ABLATIONS = ("progressive 0.3", "fixed 0.15", "fixed 0.3", "near", "far", "L1 gradient 0.01")


def made_up(scene, views, start, method, seed, lpips=True):
    cell = {"scene": scene, "views": views, "start": start, "method": method, "seed": seed, "downscale": 2.0}
    draw = random.Random(repr(cell))
    psnr = draw.uniform(20, 25)

    def quality(value):
        parts = {"ssim": 30, "ssim_zero_padded": 31, "lpips_vgg": 100, "lpips_vgg_unscaled": 110}
        return {"psnr": value} | {k: value / d if lpips or "ssim" in k else None for k, d in parts.items()}

    counts = [0, *(draw.randint(50, 100) for _ in range(5))]  # nothing in the nearest bin
    curve = [{"step": k, "seconds": k / 10, "test_psnr": psnr - 1 / k, "train_psnr": psnr} for k in (500, 1000, 2000)]
    return {
        "cell": cell | {"fit": {"steps": 2000, "drop": 0.2}},
        "result": {
            "test": quality(psnr),
            "train": quality(psnr + draw.uniform(4, 8)),
            "test_views": {"a_b.png": psnr},
            "curve": curve,
            "init": {"kind": "random" if start == "scene" else start, "points": 10_000, "seconds": 17.2},
            "gaussians": 20_000,
            "wall_seconds": draw.uniform(100, 200),
            "cpu_seconds": draw.uniform(200, 300),
            "peak_rss_mb": 600,
            "coadaptation": draw.uniform(1e-3, 2e-3),
            "thresholds": {"distance": [*range(7)], "gaussians": counts, "over": [count // 3 for count in counts]},
            "protocol": {"train": ["a"] * views, "test": ["b", "c"], "image_size": [189, 252]},
            "versions": {"kgs": "0.1.0", "machine": "x86_64, 2 cores"},
        },
    }


def full(**options):
    """Every table and plot has something to show."""
    settings = (("llff/fern", 3, "dense"), ("llff/flower", 3, "dense"), ("blender/lego", 8, "dense"))
    cells = [(*setting, method, seed) for setting in settings for method in MAIN for seed in range(3)]
    cells += [("llff/fern", 3, "dense", method, seed) for method in reversed(ABLATIONS) for seed in (0, 1)]
    cells += [("llff/fern", 3, start, "progressive 0.2", seed) for start in ("sift", "model-points") for seed in (0, 1)]
    cells += [("blender/lego", 8, "scene", method, seed) for method in MAIN for seed in range(3)]
    cells += [(scene, 6, "dense", method, 0) for scene in ("llff/fern", "llff/flower") for method in MAIN[:2]]
    return [made_up(*cell, **options) for cell in cells]


def psnrs(rows, scene, method, views=3):
    wanted = [scene, views, "dense", method]
    return [row["result"]["test"]["psnr"] for row in rows if list(row["cell"].values())[:4] == wanted]


def student(freedom):
    """Half of the 95 % interval of Student's t."""
    return float(stats.t.interval(0.95, freedom)[1])


def tiny_cell(method="off", seed=0, start="sift"):
    return {
        "scene": "synthetic",
        "views": 2,
        "downscale": None,
        "start": start,
        "method": method,
        "seed": seed,
        "fit": TINY | METHODS[method],
    }
