"""Figures of a fit: renders beside their photos, and the training curve. The caller's pyplot is left alone."""

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from kgs.datasets.scene import Views
from kgs.json_files import write_whole

# One colour for each method in all figures and pages: those of Okabe and Ito, which colour-blind people tell apart. The
# study has more of them (kgs/study/plots.py); pages show black as the colour of their text.
DEFAULT = "#CC79A7"
WITHOUT = "#000000"


def write_sheet(path: Path, views: Views, columns: dict[str, list[Tensor]], indices: list[int]) -> None:
    """Write a PNG of some views, a row each: the photo, then columns of renders `(3, H, W)` under their titles."""
    height, width = views.images.shape[-2:]
    pictures = {"photo, not used in training": list(views.images), **columns}
    figure = _figure(3 * len(pictures), 3 * height / width * len(indices) + 0.3)
    cells = figure.subplots(len(indices), len(pictures), squeeze=False)
    for column, (title, images) in zip(cells.T, pictures.items(), strict=True):
        column[0].set_title(title, fontsize="medium")
        for cell, index in zip(column, indices, strict=True):
            cell.imshow(images[index].cpu().clamp(0, 1).permute(1, 2, 0).numpy(), interpolation="bicubic")
            cell.set_axis_off()
    _write(path, figure)


def write_curve(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Plot test and training PSNR against seconds of training; runs "without ..." have a colour of their own."""
    figure = _figure(6, 4)
    axes = figure.subplots()
    for name, curve in runs.items():
        color = WITHOUT if name.startswith("without") else DEFAULT
        seconds = [point["seconds"] for point in curve]
        for part, style in (("test", "-o"), ("train", ":")):
            values = np.array([point[f"{part}_psnr"] for point in curve], float)  # None is NaN, a gap
            if np.isfinite(values).any():
                axes.plot(seconds, values, style, color=color, markersize=3, label=f"{name} {part}".strip())
    axes.set(xlabel="seconds of training", ylabel="PSNR [dB]")
    axes.grid(alpha=0.3)
    if axes.lines:
        axes.legend(frameon=False)
    _write(path, figure)


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure((width, height), layout="constrained")


def _write(path: Path, figure: Any) -> None:
    content = BytesIO()
    figure.savefig(content, format="png", dpi=120)
    write_whole(path, content.getvalue())
