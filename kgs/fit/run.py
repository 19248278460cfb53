"""A whole fit in one call: initial points, training, and leaving out what the scene does not need."""

from typing import Any

from kgs._support.errors import DataError, quoted
from kgs._support.progress import ProgressBar, silent
from kgs.datasets.scene import Scene
from kgs.init_points import InitialPoints, initial_points
from kgs.init_points.in_view import check_in_view

from .config import FitConfig
from .exposure import decide_exposure
from .fit import Fit
from .overlap import decide_by_overlap
from .plan import Plan, make_plan
from .pruning import prune
from .trainer import Trainer
from .view_dependence import decide_degree


def fit_scene(scene: Scene, config: FitConfig | None = None, *, bar: ProgressBar = silent) -> Fit:
    """Fit a scene; nothing is written. `kgs fit` does the same and writes a folder.

    Args:
        scene: posed training and test views; the test views are rendered only for the curve.
        config: the settings; None: the defaults.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.

    Raises:
        DataError: the scene, or the file of initial points, has none.
        TrainingDiverged: a number is not finite, or a scale explodes.
        ValueError: images are too small, points too few, or the device or backend is not available.
    """
    config = FitConfig() if config is None else config
    plan = make_plan(scene, config)
    points = choose_points(scene, config, bar)
    return prune(Trainer(scene, decide(plan, points), points).fit())


def decide(plan: Plan, points: InitialPoints) -> Plan:
    """The plan with what the photos settle: steps, drop rate, degree of the harmonics, and gains.

    Args:
        plan: of :func:`make_plan`.
        points: the initial points of the fit, of which "dense" and "sift" tell how many photos show the same surface.

    Returns:
        The plan with its `decisions`; what the configuration gives stays as it is.
    """
    return decide_exposure(decide_degree(decide_by_overlap(plan, points), points), points)


def choose_points(scene: Scene, config: FitConfig, bar: ProgressBar = silent) -> InitialPoints:
    """Make the initial points that `config.init` asks for.

    Args:
        scene: the scene to fit; test views are not used.
        config: the settings of the fit.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.

    Raises:
        DataError: the scene, or the file, has none, or no training image shows one.
    """
    kind = config.init
    if kind in ("scene", "model-points"):
        if len(scene.points) == 0:
            raise DataError(scene.root, "points", f"points of the layout itself for the init {kind!r}", "none")
        if (kind == "model-points") != (scene.init_kind == "model-points"):
            expected = f"points for the init {kind!r}"
            advice = "load_scene(points=...) chooses"
            raise DataError(scene.root, "points", expected, quoted(scene.init_kind), advice=advice)
        check_in_view(scene.points, scene.train, scene.root)
        return InitialPoints(scene.points, scene.point_colors, scene.init_kind)
    views = scene.train if scene.train_full_size is None else scene.train_full_size
    options: dict[str, Any] = {
        "device": config.device,
        "seed": config.seed,
        "count": config.init_points,
        "draw": config.draw,
        "pixels": scene.train.images[:, 0].numel(),
        "file": config.init_file,
        "origin": scene.offset,  # files that kgs writes are in the world's coordinates
    }
    points = initial_points(views, kind, bar=bar, backend=config.backend, **options)
    check_in_view(points.points, scene.train, config.init_file or scene.root)
    return points
