"""Pictures about a fit: renders beside their photos, and the curve of a training."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from kgs.datasets.scene import Views

from .outputs import write_whole

__all__ = ["side_by_side", "write_curve"]

LEGIBLE = 200  # pixels; narrower pictures are enlarged on a sheet


def side_by_side(views: Views, columns: dict[str, list[Tensor]], indices: list[int]) -> Tensor:
    """Pictures of some views, one row per view: the photo, then one column per method, each with its title.

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
    """Plot test and training PSNR against seconds of training, one colour per run.

    The caller's pyplot and its backend are left alone.

    Raises:
        ImportError: matplotlib is missing.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
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
    content = BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(content, format="png", dpi=120, metadata={"Software": "kgs"})
    write_whole(path, content.getvalue())
