"""Measures a fit: the content of metrics.json."""

from pathlib import Path
from typing import Any

from kgs._support.errors import ArgumentError, DataError, quoted
from kgs._support.machine import peak_rss_mb, versions
from kgs.metrics.coverage import psnr_by_coverage
from kgs.metrics.evaluate import MEASURES, evaluate_images, views_to_correct
from kgs.metrics.lpips import Lpips
from kgs.metrics.outlines import outline_levels

from .fit import Fit

_INIT_NOTES = {
    **dict.fromkeys(("dense", "sift", "random"), "initial points from training views alone"),
    "model-points": "points seen in training views, but their positions were refined with test views",
    "scene": "initial points that come with the layout",
    "file": "initial points of a file",
}
_MIN_STEPS = 300  # of a fit that shows outlines where the photos let it
_CONVENTIONS = {
    "outlines": "training views, PSNR of squares of a 24th of the longer side that another view shows",
    "color_corrected": "test views, each channel of a render with the gain and offset that fit its photo best",
    "ssim": "Kornia, 11 x 11, reflect padded; ssim_zero_padded as the published tables",
    "lpips": "VGG16 v0.1, inputs in [-1, 1]; lpips_vgg_unscaled with inputs in [0, 1] as the published tables",
    "test_views_used_for": "metrics and the curve only; no early stopping",
}


def used_init(asked: str, kind: str) -> str:
    """The kind of initial points that a fit began with, in the words of `FitConfig.init`.

    Args:
        asked: the entry `init`.
        kind: `InitialPoints.kind` of the points; those of the layout for "scene" are "random", too.
    """
    return asked if (asked, kind) == ("scene", "random") else kind


def measure(fit: Fit, lpips: Lpips | None = None) -> dict[str, Any]:
    """Measure a fit on its test and training views.

    Args:
        fit: of kgs; a splat alone has no settings.
        lpips: the perceptual metric, on the device of the fit, or None to leave it out.

    Returns:
        The content of metrics.json as plain values; None stands for what was not measured. Where the training photos
        differ in exposure, "color_corrected" has the measures of test views after an affine fit of their colours.

    Raises:
        ValueError: the fit has no settings.
    """
    scene = fit.scene
    config = fit.settings
    if config is None:
        raise ArgumentError("fit", "a fit of kgs, which has settings", "a splat alone")
    init = used_init(config.init, fit.history["init"]["kind"])
    init_note = _INIT_NOTES.get(init, "initial points that were given")
    if config.init in ("dense", "sift") and init in ("sift", "random") and init != config.init:
        init_note += f" ({config.init} was asked for, and found too few)"
    poses = "poses as given (estimated with all views in real scenes, the field's protocol)"
    if fit.history["poses"] is not None:
        poses += ", those of the training views refined by the fit"
    everywhere = all(views.valid_mask is None for views in (scene.train, scene.test))
    pixels = "all pixels" if everywhere else "the pixels that count; SSIM and LPIPS take the others as equal"
    is_long = fit.history.get("steps", 0) >= _MIN_STEPS
    train = fit.train_renders
    test = fit.test_renders
    color_corrected = {}
    if scene.train.gains is not None and len(scene.test):
        views = views_to_correct(scene)
        color_corrected["color_corrected"] = evaluate_images(test.images, views, lpips, correct_color=fit.render)
    return {
        "test": evaluate_images(test.images, scene.test, lpips) if len(scene.test) else None,
        **color_corrected,
        "train": evaluate_images(train.images, scene.train, lpips),
        "outlines": outline_levels(scene.train, train.images, train.median_depths) if is_long else {},
        "seen": psnr_by_coverage(scene, train.median_depths, test.images, test.median_depths),
        **fit.history,
        "decisions": fit.decisions.to_dict(),
        "peak_rss_mb": peak_rss_mb() or None,
        "gaussians": len(fit.model),
        "seed": config.seed,
        "drop": config.drop,
        "backend": fit.backend,
        "protocol": {
            "train": list(scene.train.names),
            "test": list(scene.test.names),
            "image_size": list(scene.train.images.shape[-2:]),
            "background": scene.background.tolist(),
            "init": f"{init}: {init_note}; {poses}",
            "psnr": f"mean over views, renders clamped to [0, 1], all channels, {pixels}",
            **_CONVENTIONS,
        },
        "versions": versions(),
    }


def measure_again(fit: Fit, path: Path, lpips: Lpips | None = None) -> dict[str, Any]:
    """The metrics of a fit that was read from its folder, measured again.

    Args:
        fit: with its metrics.
        path: of the file that they were read from, which an error names.
        lpips: the perceptual metric, or None: the old values stay.

    Raises:
        DataError: they are of other views.
    """
    scene = fit.scene
    parts = {"test": (scene.test, fit.test_renders), "train": (scene.train, fit.train_renders)}
    if fit.metrics.get("color_corrected"):
        parts["color_corrected"] = views_to_correct(scene), fit.test_renders
    fresh: dict[str, Any] = {}
    for part, (views, renders) in parts.items():
        old = fit.metrics.get(part) or {"views": []}
        try:
            old_rows = {row["name"]: row for row in old["views"]}
        except (KeyError, TypeError) as error:
            raise DataError(path, part, "the metrics of a fit", quoted(old)) from error
        if set(old_rows) != set(views.names):
            raise DataError(path, part, f"the {len(views)} views of {scene.root}", "others", advice="fit again")
        fresh[part] = None
        if old_rows:
            is_corrected = part == "color_corrected"
            new = evaluate_images(renders.images, views, lpips, correct_color=fit.render if is_corrected else None)
            if lpips is None:
                _copy_lpips(old, new)
                for row in new["views"]:
                    _copy_lpips(old_rows[row["name"]], row)
            fresh[part] = new
    return fit.metrics | fresh


def _copy_lpips(source: dict[str, Any], target: dict[str, Any]) -> None:
    """Copy the values of LPIPS, None where there are none."""
    for key in MEASURES:
        if key.startswith("lpips"):
            target[key] = source.get(key)
