"""Measures a fit: the content of metrics.json."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from kgs._support.machine import peak_rss_mb, versions
from kgs.metrics.coverage import Coverage
from kgs.metrics.evaluate import evaluate, views_to_correct
from kgs.metrics.lpips import Lpips

from .fit import Fit

_INIT_NOTES = {
    **dict.fromkeys(("dense", "sift", "random"), "initial points from training views alone"),
    "model-points": "points seen in training views, but their positions were refined with test views",
    "scene": "initial points that come with the layout",
    "file": "initial points of a file",
}
_CONVENTIONS = {
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


def measure(fit: Fit, lpips: Lpips | None = None, look: Callable[[int, Tensor], None] | None = None) -> dict[str, Any]:
    """Measure a fit on its test and training views.

    Args:
        fit: of kgs; a splat alone has no settings.
        lpips: the perceptual metric, on the device of the fit, or None to leave it out.
        look: called with the number of each test view and its render, see :func:`kgs.metrics.evaluate.evaluate`.

    Returns:
        The content of metrics.json as plain values; None stands for what was not measured. Where the training photos
        differ in exposure, "color_corrected" has the measures of test views after an affine fit of their colours.

    Raises:
        ValueError: the fit has no settings, or no history, as one that was read from its folder.
    """
    scene = fit.scene
    config = fit.settings
    if config is None:
        raise ValueError("fit: expected a fit of kgs, which has settings, got a splat alone")
    if not fit.history:
        raise ValueError("fit: expected one that was just made, got one that was read from its folder: it has metrics")
    init = used_init(config.init, fit.history["init"]["kind"])
    init_note = _INIT_NOTES.get(init, "initial points that were given")
    if config.init in ("dense", "sift") and init in ("sift", "random") and init != config.init:
        init_note += f" ({config.init} was asked for, and found too few)"
    poses = "poses as given (estimated with all views in real scenes, the field's protocol)"
    if fit.history["poses"] is not None:
        poses += ", those of the training views refined by the fit"
    everywhere = all(views.valid_mask is None for views in (scene.train, scene.test))
    pixels = "all pixels" if everywhere else "the pixels that count; SSIM and LPIPS take the others as equal"
    coverage = Coverage(scene, fit.median_depth)

    def look_at(view: int, image: Tensor) -> None:
        coverage.add(view, image)
        if look is not None:
            look(view, image)

    color_corrected = {}
    if scene.train.gains is not None and len(scene.test):
        color_corrected["color_corrected"] = evaluate(fit.render, views_to_correct(scene), lpips, correct_color=True)
    return {
        "test": evaluate(fit.render, scene.test, lpips, look=look_at) if len(scene.test) else None,
        **color_corrected,
        "train": evaluate(fit.render, scene.train, lpips),
        "seen": coverage.means(),
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
