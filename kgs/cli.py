"""The command `kgs`: demo, fit, render, eval, bench."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from .bench.command import bench
from .errors import DataError, TrainingDiverged
from .options import alias

__all__ = ["main"]

_EXTRA = {
    "tyro": "app",
    "tqdm": "app",
    "matplotlib": "app",
    "viser": "view",
    "pycolmap": "sfm",
    "distributed": "cluster",
}


def main(arguments: list[str] | None = None) -> None:
    """Run one command; errors of the user are one line and exit code 2, a fit that a signal stopped has 128 + that."""
    try:
        import tyro

        commands: dict[str, Any] = {"demo": demo, "fit": fit, "render": render, "eval": evaluate, "bench": bench}
        code: int = tyro.extras.subcommand_cli_from_dict(
            commands, prog="kgs", description=sys.modules[__package__].__doc__, args=arguments
        )
    except ModuleNotFoundError as error:
        extra = _EXTRA.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        _fail(f'{error.name} is missing: pip install "kgs-splat[{extra}]"')
    except (DataError, ValueError, TypeError) as error:
        _fail(str(error))
    except TrainingDiverged as error:
        _fail(f"training diverged: {error}", 1)
    except OSError as error:
        _fail(str(error), 1)
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(code)


def demo(
    *,
    out: Annotated[Path, alias("-o")] = Path("demo"),
    steps: int | None = None,
    size: tuple[int, int] = (54, 72),
    seed: int = 0,
) -> int:
    """Three views of a built-in scene, fitted without and with DropGaussian, compared on views not used.

    Args:
        out: folder for demo.png, curve.png and metrics.json.
        steps: iterations of each of the two fits; the default fits into 3 minutes on 2 cores.
        size: height and width of the pictures.
        seed: the scene, the first points and both fits derive from it.
    """
    from kgs.datasets import synthetic_scene

    from .fit.demo import DEMO, run_demo

    scene = synthetic_scene(train_views=3, size=size, seed=seed)
    runs = run_demo(scene, out, replace(DEMO, seed=seed, steps=steps or DEMO.steps))
    print(f"\n{'':22}{'PSNR':>8}{'SSIM':>8}{'train PSNR':>12}{'Gaussians':>11}{'seconds':>9}")
    for name, run in runs.items():
        print(
            f"{name + ' DropGaussian':<22}{run['test']['psnr']:8.2f}{run['test']['ssim']:8.3f}"
            f"{run['train']['psnr']:12.2f}{run['gaussians']:11d}{run['seconds']:9.1f}"
        )
    gain = runs["with"]["test"]["psnr"] - runs["without"]["test"]["psnr"]
    print(f"\ndifference on test views: {gain:+.2f} dB (one seed; try --seed 1, 2, ...)")
    print(f"pictures: {out / 'demo.png'}")
    return 0


def fit(
    scene: Path,
    /,
    *,
    out: Annotated[Path, alias("-o")],
    views: int | None = None,
    downscale: float | None = None,
    fast: bool = False,
    steps: int | None = None,
    drop: float = 0.2,
    drop_schedule: Literal["linear", "constant"] = "linear",
    seed: int = 0,
    init: Literal["dense", "sift", "random", "scene", "model-points", "file"] = "dense",
    init_file: Path | None = None,
    init_points: int = 10_000,
    max_gaussians: int | None = None,
    sh_degree: int = 3,
    background: Literal["black", "white"] = "black",
    lpips_weights: Path | None = None,
    device: str = "cpu",
    resume: bool = False,
) -> int:
    """Turn a folder of posed images into a splat, with test metrics.

    Args:
        scene: LLFF, COLMAP, Blender or nerfstudio folder.
        out: folder for splat.ply, metrics.json, test/*.png, curve.png, config.json and the checkpoint.
        views: training views, spread over the views that are not held out; all of them unless given.
        downscale: shrink the images by this factor.
        fast: a third of the time for 0.1 to 0.5 dB less PSNR of test views, and a little less SSIM: half the steps at
            twice the rates, most of them on pictures of half the width.
        steps: iterations, 2000 unless given (1000 with --fast); the counts of the recipe (10 000 steps) are scaled to
            it.
        drop: final rate of DropGaussian; 0 leaves it out.
        drop_schedule: linear grows with the steps, as in the paper; constant is dropout at that rate.
        seed: everything random derives from it.
        init: first points. dense: from depth maps of the training images, made by a plane sweep in some seconds a
            view. sift: from matches of their keypoints. random: where at least two images see. scene: the random points
            that Blender's layout prescribes. model-points: of a COLMAP model, made with the test views.
        init_file: a point cloud (PLY, OBJ, ...) for --init file.
        init_points: how many first points --init random gives, and dense at most.
        max_gaussians: densification stops there; 10 a step, and at least twice the first points,
            unless given (14000 with --fast).
        sh_degree: degree of the view-dependent colour.
        background: behind images with transparency.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is left out.
        device: cpu, cuda, ...
        resume: continue from the checkpoint in the output folder.
    """
    from .fit.config import FAST, FitConfig
    from .fit.run import fit_scene

    start = FAST if fast else FitConfig()
    config = replace(
        start,
        steps=start.steps if steps is None else steps,
        drop=drop,
        drop_schedule=drop_schedule,
        sh_degree=sh_degree,
        seed=seed,
        init=init,
        init_file=init_file,
        init_points=init_points,
        max_gaussians=start.max_gaussians if max_gaussians is None else max_gaussians,
        device=device,
    )
    request = {
        "scene": os.path.abspath(scene),
        "train_views": views,
        "downscale": downscale,
        "background": background,
        "points": "model-points" if init == "model-points" else "none",
    }
    lpips = _load_lpips(lpips_weights, device)
    loaded = _load(request)
    height, width = loaded.train.images.shape[-2:]
    print(f"{scene}: {len(loaded.train)} training and {len(loaded.test)} test views of {width}x{height}")
    if width * height > 1e6 and device == "cpu":
        megapixels, minutes = width * height / 1e6, width * height * config.steps / 1.5e9
        print(f"{megapixels:.1f} Mpx on a CPU: expect about {minutes:.0f} minutes; see --downscale")
    metrics, stopped_by = fit_scene(loaded, config, out, resume=resume, lpips=lpips, request=request)
    _print_metrics(metrics)
    print(f"{out / 'splat.ply'}: {metrics['gaussians']} Gaussians after {metrics['steps']} steps")
    return 128 + stopped_by if stopped_by else 0


def render(
    ply: Path,
    /,
    *,
    out: Annotated[Path, alias("-o")],
    cameras: Path,
    downscale: float | None = None,
    background: Literal["black", "white"] = "black",
    device: str = "cpu",
) -> int:
    """Render a splat from every camera of a scene into PNGs.

    Args:
        ply: a 3DGS PLY file.
        out: folder for the PNGs, named like the scene's images.
        cameras: the scene (LLFF, COLMAP, Blender or nerfstudio folder) whose cameras to use.
        downscale: shrink the pictures by this factor.
        background: behind the splat.
        device: cpu, cuda, ...
    """
    from kgs.datasets import load_scene

    from .fit.render import render_views

    count = render_views(ply, load_scene(cameras, None, downscale, background=background), out, device)
    print(f"{count} pictures in {out}")
    return 0


def evaluate(out: Path, /, *, lpips_weights: Path | None = None, device: str = "cpu") -> int:
    """Measure a fit again on its test views and bring its metrics.json up to date.

    Args:
        out: the output folder of `kgs fit`.
        lpips_weights: folder with VGG16 and LPIPS weights (npz); without it LPIPS is left out.
        device: cpu, cuda, ...
    """
    from .fit.outputs import write_json
    from .fit.run import CHECKPOINT, measure
    from .fit.settings import read_settings
    from .fit.trainer import Trainer
    from .json_files import read_json

    lpips = _load_lpips(lpips_weights, device)
    request, config = read_settings(out / "config.json")
    metrics = read_json(out / "metrics.json")
    trainer = Trainer.resume(_load(request), replace(config, device=device), out / CHECKPOINT)
    metrics |= measure(trainer, lpips)
    write_json(out / "metrics.json", metrics)
    _print_metrics(metrics)
    return 0


def _load(request: dict[str, Any]) -> Any:
    from kgs.datasets import load_scene

    return load_scene(
        Path(request["scene"]),
        request["train_views"],
        request["downscale"],
        background=request["background"],
        points=request["points"],
    )


def _load_lpips(folder: Path | None, device: str) -> Any:
    if folder is None:
        return None
    from .fit.lpips import Lpips

    return Lpips.load(folder).to(device)


def _print_metrics(metrics: dict[str, Any]) -> None:
    names = {"psnr": "PSNR", "ssim": "SSIM", "ssim_zero_padded": "SSIM (zero padded)", "lpips_vgg": "LPIPS"}
    for part in ("test", "train"):
        values = metrics[part] or {}
        shown = [f"{title} {values[key]:.4g}" for key, title in names.items() if values.get(key) is not None]
        if shown:
            print(f"{part:>5}: " + ", ".join(shown))


def _fail(message: str, code: int = 2) -> None:
    print(f"kgs: {message}", file=sys.stderr)
    sys.exit(code)
