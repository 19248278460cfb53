"""Fits in a folder, as `kgs fit` makes them of a scene that is loaded."""

from pathlib import Path
from typing import Any

from kgs.app.files.results import Results
from kgs.app.fit_folder import Published, fit_folder
from kgs.app.scene_request import SceneRequest
from kgs.datasets import Scene
from kgs.fit import FitConfig


def fit_in(
    scene: Scene, config: FitConfig, out: Path, request: SceneRequest, resume: bool = False, **options: Any
) -> Published:
    """Fit a scene in the folder `out`; options are those of `fit_folder`."""
    with Results.open(out, "fit", ["photos"], resume) as results:
        return fit_folder(scene, config, results, request, resume=resume, **options)
