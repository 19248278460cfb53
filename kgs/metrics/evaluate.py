"""Measures renders against photos: PSNR, SSIM with both borders, LPIPS.

Compared are float renders, clamped to [0, 1], never 8-bit files, over all pixels and channels (alpha is not used). The
photos' dark border, if any, is applied to the renders first. Pixels that do not count (`Views.valid_mask`) are black in
both; PSNR is that of the others, while SSIM and LPIPS take the black ones as equal.

Sources: the SSIM of the published tables is that of B. Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance
Field Rendering", SIGGRAPH 2023: an 11-tap Gaussian window of deviation 1.5, a border of zeros, the mean over the map.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from statistics import fmean
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from kornia.metrics import psnr, ssim
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs.datasets.scene import Scene, Views

from .lpips import Lpips

MEASURES = ("psnr", "ssim", "ssim_zero_padded", "lpips_vgg", "lpips_vgg_unscaled")
BEST = 200.0  # decibels that stand for an infinite PSNR in comparisons
_WINDOW = 11


@torch.no_grad()
def evaluate(
    render: Callable[..., Tensor], views: Views, lpips: Lpips | None = None, *, correct_color: bool = False
) -> dict[str, Any]:
    """Render each view from its camera, to `(1, 3, H, W)`, and compare it with its photo; no gradients are kept.

    `render` is called with a camera and, where views have gains, with gains, as :meth:`kgs.fit.Fit.render` takes them.
    All else is as of :func:`evaluate_images`.
    """
    images = (views.render(index, render) for index in range(len(views)))
    return evaluate_images(images, views, lpips, correct_color=render if correct_color else None)


@torch.no_grad()
def evaluate_images(
    images: Iterable[Tensor],
    views: Views,
    lpips: Lpips | None = None,
    *,
    correct_color: Callable[..., Tensor] | None = None,
) -> dict[str, Any]:
    """Compare the render of each view, `(1, 3, H, W)`, with its photo.

    Args:
        images: the renders in the order of the views, as :meth:`kgs.datasets.scene.Views.render` returns them.
        views: with at least 6 x 6 pixels, 16 x 16 with `lpips`.
        lpips: a network on the device of the renders; None: LPIPS is not measured.
        correct_color: the function that renders, to give each channel of a render the gain and the offset that fit it
            best to the photo first: what exposure and white balance of a held-out photo do is then not counted. Where
            views have gains, and masks let a background show through, only the colours of the scene get them. None:
            the renders are compared as they are.

    Returns:
        Means over views under "psnr" (dB), "ssim" (Kornia's, reflected border), "ssim_zero_padded" (that of the
        published tables), "lpips_vgg" (images in [-1, 1], as in its training) and "lpips_vgg_unscaled" (in [0, 1],
        as in the published tables); under "views" a list with "name" and the same keys for each view. None stands for
        what was not measured, and for an infinite PSNR (a render equal to its photo, or a mean with one). Where not all
        pixels count, "valid" is the share that does.

    Raises:
        ValueError: a render differs in shape from its photo or holds NaN or infinity.
    """
    rows = list[dict[str, Any]]()
    shares = list[float]()
    for index, (name, image) in enumerate(zip(views.names, images, strict=True)):
        target = views.images[index : index + 1]
        if image.shape != target.shape:
            raise ArgumentError("render", f"shape {tuple(target.shape)} for {name}", tuple(image.shape))
        if not bool(image.isfinite().all()):
            raise ArgumentError("render", f"finite values for {name}", "NaN or infinity")
        shown, photo, share = views.compared(index, image)
        if correct_color is not None:
            valid = None if views.valid_mask is None else views.valid_mask[index]
            through = None
            if views.alphas is not None and views.gains is not None:
                background = correct_color(views.camera(index), torch.zeros(3))
                through = Through(background, views.alphas[index].to(image))
                if views.border_mask is not None:  # the border darkens the background, too
                    valid = (views.border_mask >= 1) & (True if valid is None else valid)
            shown, _, _ = views.compared(index, color_corrected(image, shown, photo, valid, through))
        shares.append(share)
        rows.append(_measure(shown, photo[None], share, lpips))
    columns = {key: [row[key] for row in rows] for key in MEASURES}
    means = {key: fmean(values) if values and None not in values else None for key, values in columns.items()}
    if views.valid_mask is not None and shares:
        means["valid"] = round(fmean(shares), 4)
    return {**means, "views": [{"name": name, **row} for name, row in zip(views.names, rows, strict=True)]}


def views_to_correct(scene: Scene) -> Views:
    """The test views for `correct_color`; with gains of 1 where the training views have gains."""
    views = scene.test
    return views if scene.train.gains is None else replace(views, gains=torch.ones(len(views), 3))


class Through(NamedTuple):
    """What shows through a view."""

    background: Tensor  # (1, 3, H, W), what shows of the background in the render
    alpha: Tensor  # (1, H, W), the share of the scene in each pixel of the photo


def color_corrected(
    image: Tensor, shown: Tensor, photo: Tensor, valid: Tensor | None = None, through: Through | None = None
) -> Tensor:
    """A render `(1, 3, H, W)` with the gain and offset of each channel that fit `shown` to the photo `(3, H, W)`.

    `shown` is the render as it is compared with the photo; least squares in float64 over the pixels `(H, W)` that
    are valid, or over all. The background that shows through gets neither gain nor offset.
    """
    every = slice(None) if valid is None or not bool(valid.any()) else valid.flatten().to(shown.device)
    behind, alpha = (torch.zeros_like(image), torch.ones_like(image[0, :1])) if through is None else through
    x = (shown - behind)[0].flatten(1)[:, every].double()
    y = (photo - behind[0]).flatten(1)[:, every].double()
    a = alpha.flatten(1)[:, every].double()
    total = a.square().sum().clamp_min(1e-12)
    mean_x = (a * x).sum(1, keepdim=True) / total
    mean_y = (a * y).sum(1, keepdim=True) / total
    rest = x - a * mean_x
    variance = rest.square().sum(1, keepdim=True)
    gain = torch.where(variance > 0, (rest * (y - a * mean_y)).sum(1, keepdim=True) / variance, 1.0)
    offset = mean_y - gain * mean_x
    return (image - behind) * gain[:, :, None].to(image) + offset[:, :, None].to(image) * alpha + behind


def mean_psnr(render: Callable[..., Tensor], views: Views) -> float | None:
    """Mean PSNR over some views in dB, of clamped renders; None without views, or if one PSNR is infinite.

    `render` is called as by :meth:`kgs.datasets.scene.Views.render`.
    """
    levels = [view_psnr(views.render(i, render), views, i) for i in range(len(views))]
    return round(fmean(levels), 4) if levels and math.isfinite(sum(levels)) else None


def view_psnr(image: Tensor, views: Views, index: int) -> float:
    """PSNR in dB of the render of one view, `(1, 3, H, W)`, clamped; infinity if it equals its photo."""
    shown, photo, share = views.compared(index, image[0].cpu())
    return masked_psnr(shown, photo, share)


def masked_psnr(image: Tensor, photo: Tensor, share: float) -> float:
    """PSNR in dB over the share of the pixels that count; the others are equal in both images."""
    return float(psnr(image, photo, 1.0)) + 10 * math.log10(share) if share else math.inf


def clipped_psnr(level: float | None) -> float:
    """A PSNR in dB, at most `BEST`; None, an infinite one, is `BEST`."""
    return BEST if level is None else min(level, BEST)


def _measure(image: Tensor, target: Tensor, share: float, lpips: Lpips | None) -> dict[str, float | None]:
    """The `MEASURES` of one image, of whose pixels a share counts."""
    level = masked_psnr(image, target, share)
    # Kornia's "valid" map of zero-padded images is the whole map with zero padding.
    border = [_WINDOW // 2] * 4
    padded = F.pad(image, border)
    padded_target = F.pad(target, border)
    values = (
        level if math.isfinite(level) else None,
        ssim(image, target, _WINDOW).mean().item(),
        ssim(padded, padded_target, _WINDOW, eps=0.0, padding="valid").mean().item(),
        *(None if lpips is None else lpips(image, target, rescale).item() for rescale in (True, False)),
    )
    return dict(zip(MEASURES, values, strict=True))


def brightness_note(metrics: dict[str, Any]) -> str:
    """A sentence about held-out photos that differ in brightness from each other, in colours that were corrected."""
    level = clipped_psnr(metrics["test"]["psnr"])
    return (
        "The photos differ in brightness: held-out renders are measured in the colours that fit their photos best; as "
        f"they are, PSNR {level:.4g}."
    )


def as_text(metrics: dict[str, Any]) -> str:
    """The metrics of a fit as lines of text."""
    lines = list[str]()
    names = {"psnr": "PSNR", "ssim": "SSIM", "lpips_vgg": "LPIPS"}
    if held_out := metrics.get("held_out"):
        measured = [f"{title} {held_out[key]:.4g}" for key, title in names.items() if held_out.get(key) is not None]
        names_of = ", ".join(view["name"] for view in held_out["views"])
        lines.append(f"a fit without {names_of} shows it with {', '.join(measured)}")
    corrected = metrics.get("color_corrected")
    for part in ("test", "train"):
        values = (corrected if part == "test" else None) or metrics.get(part) or {}
        measured = [f"{title} {values[key]:.4g}" for key, title in names.items() if values.get(key) is not None]
        if measured:
            share = values.get("valid")
            where = "" if share is None else f" (of {share:.0%} of the pixels: masks leave out the rest)"
            lines.append(f"{part:>5}: {', '.join(measured)}{where}")
    if corrected:
        lines.append(brightness_note(metrics))
    coverage = metrics.get("seen") or {}
    level = coverage.get("psnr")
    rest = coverage.get("psnr_rest")
    if level is not None and rest is not None:
        percent = 100 * coverage["share"]
        lines.append(f" test: {percent:.0f} % is in two training views, PSNR {level:.4g}; the rest {rest:.4g}")
    if not metrics["test"] and not held_out:
        lines.append(
            "no photo was held out: how good other views are was not measured (see --measure and --hold-out). "
            "Every fit comes close to its own photos."
        )
    return "\n".join(lines)
