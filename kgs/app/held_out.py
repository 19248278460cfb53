"""Measures how good other views are: on a photo that a fit of the other photos did not have."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from kgs.datasets.source import SceneSource
from kgs.fit.config import FitConfig
from kgs.fit.measures import measure
from kgs.metrics.lpips import Lpips

from .scene_request import SceneRequest
from .training import Training

MIN_TO_MEASURE = 4  # three to fit, and one to measure


def measure_held_out(
    request: SceneRequest,
    source: SceneSource,
    count: int,
    config: FitConfig,
    lpips: Lpips | None = None,
    say: Callable[[str], None] | None = None,
) -> tuple[dict[str, Any], int]:
    """Fit all photos but one from the middle of the row of cameras, and measure that one. Nothing is written.

    Args:
        request: how the scene is loaded; all photos are training views.
        source: the folder of a scene whose cameras kgs found.
        count: how many photos it has, at least `MIN_TO_MEASURE`.
        config: the settings of the fit of all photos, which are those of this fit.
        lpips: the perceptual metric, or None to leave it out.
        say: gets the notes of the fit.

    Returns:
        The measures of the photo, as "test" in metrics.json has them, and the number of the signal that ended the
        training, or 0.
    """
    held_out = replace(request, hold_out=count)  # of so many the one in the middle; the offset follows the others
    scene = held_out.load(source.root, None, source)
    training = Training(title="measurement")
    _, fit = training.fit(scene, replace(config, evaluations=1))
    if say is not None:
        for note in fit.notes:
            say(note)
    metrics = {} if training.signal else measure(fit, lpips)
    return metrics.get("color_corrected") or metrics.get("test") or {}, training.signal
