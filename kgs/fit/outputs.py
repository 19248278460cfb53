"""What a fit leaves behind: metrics.json, PNGs and the curve."""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import kornia
import numpy as np
import torch
from torch import Tensor

from kgs import __version__
from kgs.datasets.scene import Views
from kgs.errors import DataError
from kgs.json_files import read_json

from .trainer import Trainer

__all__ = [
    "peak_rss_mb",
    "png_name",
    "read_json",
    "run_metrics",
    "side_by_side",
    "versions",
    "write_curve",
    "write_json",
    "write_png",
]

LEGIBLE = 200  # pixels; narrower pictures are enlarged on a sheet


def run_metrics(
    trainer: Trainer, test: dict[str, Any] | None, train: dict[str, Any] | None, protocol: dict[str, Any]
) -> dict[str, Any]:
    """One run as it stands in metrics.json; measures that were not taken are None."""
    return {
        "test": test,
        "train": train,
        "curve": trainer.curve,
        "seconds": round(trainer.seconds, 2),
        "peak_rss_mb": peak_rss_mb(),
        "gaussians": len(trainer.model),
        "steps": trainer.step,
        "seed": trainer.config.seed,
        "drop": trainer.config.drop,
        "init": trainer.init,
        "protocol": protocol,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Versions of what decides the result."""
    return {
        "kgs": __version__,
        "torch": torch.__version__,
        "kornia": kornia.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def peak_rss_mb() -> int:
    """Largest resident memory of this process so far, in MiB."""
    status = Path("/proc/self/status")
    if status.exists():  # what getrusage says on Linux can be the peak of the process that started this one
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return round(int(line.split()[1]) / 2**10)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10))


def write_json(path: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    temporary = path.with_name(path.name + ".partial")
    temporary.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(temporary, path)


def png_name(view: str) -> str:
    """A file name for a render of a view: folders in the view's name become part of it."""
    return str(PurePosixPath(view).with_suffix(".png")).replace("/", "_")


def write_png(path: Path, image: Tensor) -> None:
    """Write an RGB image `(3, H, W)`, clamped to [0, 1] and rounded to 8 bits."""
    array = (image.detach().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).cpu().numpy()
    ok, content = cv2.imencode(".png", np.ascontiguousarray(array[:, :, ::-1]))
    if not ok:
        raise DataError(path, "", "expected an image that can be encoded, got another")
    path.write_bytes(content.tobytes())


def side_by_side(views: Views, columns: dict[str, list[Tensor]], indices: list[int]) -> Tensor:
    """Pictures of some views, one row a view: the photo, then one column a method, each with its title.

    Args:
        views: where the photos are.
        columns: title to renders `(3, H, W)` of all views.
        indices: the views to show.

    Returns:
        `(3, H', W')`; small pictures are enlarged by a whole factor.
    """
    gap, header, rows = 4, 18, []
    enlarge = max(1, -(-LEGIBLE // views.images.shape[-1]))
    for i in indices:
        pictures = torch.stack([views.images[i], *(renders[i].cpu().clamp(0, 1) for renders in columns.values())])
        pictures = torch.nn.functional.interpolate(pictures, scale_factor=enlarge, mode="bicubic").clamp(0, 1)
        rows.append(torch.cat([torch.nn.functional.pad(p, (0, gap, 0, gap), value=1.0) for p in pictures], 2))
    sheet = torch.nn.functional.pad(torch.cat(rows, 1)[:, :-gap, :-gap], (0, 0, header, 0), value=1.0)
    canvas = np.ascontiguousarray((sheet.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8))
    width = views.images.shape[-1] * enlarge + gap
    for k, title in enumerate(["photo, not used in training", *columns]):
        cv2.putText(canvas, title, (k * width + 2, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
    return torch.from_numpy(canvas).permute(2, 0, 1) / 255


def write_curve(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Plot test and training PSNR against seconds of training, one colour a run.

    Raises:
        ImportError: matplotlib is missing.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for k, (name, curve) in enumerate(runs.items()):
        seconds = [point["seconds"] for point in curve]
        for key, style in (("test_psnr", "-o"), ("train_psnr", ":")):
            values = [np.nan if point[key] is None else point[key] for point in curve]
            label = f"{name} {key.split('_')[0]}".strip()
            axes.plot(seconds, values, style, color=f"C{k}", markersize=3, label=label)
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("PSNR [dB]")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
