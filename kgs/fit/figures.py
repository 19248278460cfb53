"""Pictures about a fit: renders beside their photos, and the curve of a training. The caller's pyplot is left alone."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from kgs.datasets.scene import Views

from .outputs import write_whole

__all__ = ["write_curve", "write_sheet"]

_DPI = 120


def write_sheet(path: Path, views: Views, columns: dict[str, list[Tensor]], indices: list[int]) -> None:
    """Write pictures of some views, one row per view: the photo, then one column per method, each with its title.

    Args:
        path: the PNG to write.
        views: where the photos are.
        columns: title to renders `(3, H, W)` of all views.
        indices: the views to show.

    Raises:
        ImportError: matplotlib is missing.
    """
    height, width = views.images.shape[-2:]
    pictures = {"photo, not used in training": list(views.images), **columns}
    figure = _figure(3 * len(pictures), 3 * height / width * len(indices) + 0.3)
    for row, axes in zip(indices, figure.subplots(len(indices), len(pictures), squeeze=False), strict=True):
        for cell, (title, images) in zip(axes, pictures.items(), strict=True):
            cell.imshow(images[row].cpu().clamp(0, 1).permute(1, 2, 0).numpy(), interpolation="bicubic")
            cell.set_axis_off()
            if row == indices[0]:
                cell.set_title(title, fontsize="medium")
    _write(path, figure)


def write_curve(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Plot test and training PSNR against seconds of training, one colour per run.

    Raises:
        ImportError: matplotlib is missing.
    """
    figure = _figure(6, 4)
    axes = figure.subplots()
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
    _write(path, figure)


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    return FigureCanvasAgg(Figure((width, height), layout="constrained")).figure


def _write(path: Path, figure: Any) -> None:
    content = BytesIO()
    figure.savefig(content, format="png", dpi=_DPI, metadata={"Software": "kgs"})
    write_whole(path, content.getvalue())
