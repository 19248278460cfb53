"""Every number of a fit, as frozen dataclasses.

Source: the official release of "DropGaussian" (CVPR 2025) for the recipe, which is that of Kerbl et al. 2023 with
another densification threshold and without pruning by size.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

__all__ = ["FAST", "FitConfig", "Recipe", "Timetable", "timetable"]

_MIN_DENSIFICATIONS = 20
_MOST_STEPS = 10_000_000
_SEEDS = 2**59  # ten times a seed is one of torch's
_DROP_BY = ("random", "high-gradient", "low-gradient", "near", "far")
_OPACITY_L1_BY = ("gradient", "distance")


@dataclass(frozen=True)
class Recipe:
    """The recipe for `steps` = 10 000; a shorter fit scales the counts and keeps the rates.

    Args:
        steps: iterations, counted from 1; one training view each.
        lr_means: learning rate of the centres at the start, times the extent of the training cameras.
        lr_means_final: the same at the end, reached log-linearly.
        lr_sh_dc: of the colour without direction.
        lr_sh_rest: of the higher harmonics.
        lr_opacity: of the opacity logits.
        lr_scales: of the logarithms of the scales.
        lr_quats: of the quaternions.
        adam_eps: Adam's epsilon; torch's default would stall the small gradients.
        sh_interval: every so many steps one more degree of the harmonics is switched on.
        dssim_weight: loss = L1 + dssim_weight (1 - SSIM).
        densify_from: no densification up to this step.
        densify_interval: steps between two densifications.
        grad_threshold: mean gradient in normalised device coordinates from which a Gaussian is densified.
        percent_dense: largest scale, relative to the extent, up to which it is cloned rather than split.
        prune_opacity: Gaussians below are removed.
        reset_interval: steps between two resets of all opacities.
        reset_opacity: what they are lowered to.
        reset_recovery: a reset is left out where fewer steps than this follow before the next one or the end.
        near_plane: times the 1st percentile of the first points' depths.
    """

    steps: int = 10_000
    lr_means: float = 1.6e-4
    lr_means_final: float = 1.6e-6
    lr_sh_dc: float = 2.5e-3
    lr_sh_rest: float = 1.25e-4
    lr_opacity: float = 0.05
    lr_scales: float = 0.005
    lr_quats: float = 0.001
    adam_eps: float = 1e-15
    sh_interval: int = 1000
    dssim_weight: float = 0.2
    densify_from: int = 500
    densify_interval: int = 100
    grad_threshold: float = 5e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    reset_interval: int = 3000
    reset_opacity: float = 0.01
    reset_recovery: int = 300
    near_plane: float = 0.05

    def __post_init__(self) -> None:
        _check_types(self)
        for name in ("steps", "sh_interval", "densify_interval", "reset_interval", "lr_means", "lr_means_final"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected a number above 0, got {getattr(self, name)}")


@dataclass(frozen=True)
class FitConfig:
    """What one fit is asked to do.

    Args:
        steps: iterations; other numbers than the recipe's 10 000 scale its counts, see :func:`timetable`.
        drop: final rate of DropGaussian, in [0, 1); 0 leaves the layer out.
        drop_schedule: "linear" (the paper's) or "constant".
        drop_by: "random" (the method), or by scores those with the highest or lowest mean gradient ("high-gradient",
            "low-gradient"), those nearest to or farthest from the camera ("near", "far").
        opacity_l1: weight of the L1 penalty on opacities, see :func:`kgs.losses.opacity_l1`; 0 leaves it out.
        opacity_l1_by: it is heavier on Gaussians with a low mean "gradient", or at a great "distance".
        sh_degree: degree of the harmonics, 0 to 3.
        coarse: share of the steps, the first ones, that see the training views in half the pixels a side; in [0, 1].
        seed: views, splits, masks and random points are drawn from streams that derive from it.
        init: first points: "dense", "sift", "random", "scene" (the random ones that Blender's layout prescribes),
            "model-points" (positions refined with test views), or "file".
        init_file: point cloud for "file".
        init_points: how many points "random" gives, and "dense" at most; at least 1.
        max_gaussians: densification stops there; None: 10 a step, and at least twice the first points.
        growth: share of the steps over which the limit rises to that, evenly, from the first points; 0 sets it at
            once. In [0, 1].
        max_bytes: bound for the working memory of a render, see :class:`GaussianRenderer`; it changes
            rounding alone.
        evaluations: how often the curve is measured, the last time at the end.
        device: "cpu", "cuda", ...
        recipe: all the other numbers.
    """

    steps: int = 2000
    drop: float = 0.2
    drop_schedule: str = "linear"
    drop_by: str = "random"
    opacity_l1: float = 0.0
    opacity_l1_by: str = "gradient"
    sh_degree: int = 3
    coarse: float = 0.0
    seed: int = 0
    init: str = "dense"
    init_file: Path | None = None
    init_points: int = 10_000
    max_gaussians: int | None = None
    growth: float = 0.0
    max_bytes: int = 2**30
    evaluations: int = 8
    device: str = "cpu"
    recipe: Recipe = field(default_factory=Recipe)

    def __post_init__(self) -> None:
        _check_types(self)
        for name in ("steps", "evaluations"):
            if not 1 <= getattr(self, name) <= _MOST_STEPS:
                raise ValueError(f"{name}: expected at least 1 and at most {_MOST_STEPS}, got {getattr(self, name)}")
        if not isinstance(self.max_gaussians, int | None):
            raise ValueError(f"max_gaussians: expected a whole number, got {self.max_gaussians!r}")
        if abs(self.seed) >= _SEEDS:
            raise ValueError(f"seed: expected a number below 2^59, got {self.seed}")
        if not 0.0 <= self.drop < 1.0:
            raise ValueError(f"drop: expected a rate in [0, 1), got {self.drop}")
        for name, choices in (("drop_by", _DROP_BY), ("opacity_l1_by", _OPACITY_L1_BY)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name}: expected one of {list(choices)}, got {getattr(self, name)!r}")
        if self.opacity_l1 < 0.0:
            raise ValueError(f"opacity_l1: expected a weight of at least 0, got {self.opacity_l1}")
        for name in ("coarse", "growth"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected a share in [0, 1], got {getattr(self, name)}")
        for name in ("init_points", "max_bytes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")
        if not 0 <= self.sh_degree <= 3:
            raise ValueError(f"sh_degree: expected 0 to 3, got {self.sh_degree}")

    def to_dict(self) -> dict[str, Any]:
        """The numbers as plain values, for JSON and checkpoints."""
        values = asdict(self)
        values["init_file"] = None if self.init_file is None else str(self.init_file)
        return values

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> FitConfig:
        """The inverse of `to_dict`.

        Raises:
            ValueError: an entry is unknown or out of range.
        """
        if not isinstance(values, dict) or not isinstance(values.get("recipe", {}), dict):
            raise ValueError("values: expected the entries of a FitConfig, got others")
        init_file = values.get("init_file")
        if not isinstance(init_file, str | None):
            raise ValueError(f"init_file: expected a path, got {init_file!r}")
        try:
            recipe = Recipe(**values.get("recipe", {}))
            return cls(**{**values, "init_file": None if init_file is None else Path(init_file), "recipe": recipe})
        except TypeError as error:
            raise ValueError(f"values: expected the entries of a FitConfig, got {error}") from error


@dataclass(frozen=True)
class Timetable:
    """The iterations at which things happen in a fit of a given length.

    Args:
        sh: before these steps one more degree of harmonics is switched on.
        densify: after these steps Gaussians are cloned, split and pruned.
        reset: after these steps all opacities are lowered.
        evaluate: after these steps the curve is measured (before a densification).
        coarse: up to this step the training views are seen in half the pixels a side.
    """

    sh: tuple[int, ...]
    densify: tuple[int, ...]
    reset: tuple[int, ...]
    evaluate: tuple[int, ...]
    coarse: int


def timetable(config: FitConfig) -> Timetable:
    """Scale the recipe's counts by steps / 10 000.

    The interval of densification is shortened only as far as a short fit needs to densify about 20 times, and never
    under 10 steps: on less evidence than the recipe's the number of Gaussians explodes. An opacity reset is left out
    where fewer than `reset_recovery` steps follow before the next one or the end: the opacities would not come back.
    """
    recipe, steps = config.recipe, config.steps
    scale = steps / recipe.steps
    interval = max(10, round(min(recipe.densify_interval, steps / _MIN_DENSIFICATIONS) * max(1.0, scale)))
    begin = round(recipe.densify_from * scale)
    densify = tuple(step for step in range(interval, steps, interval) if step > begin)
    spacing = max(1, round(recipe.reset_interval * scale))
    resets = list(range(spacing, steps, spacing))
    reset = tuple(step for step, then in pairwise([*resets, steps]) if then - step >= recipe.reset_recovery)
    sh = [round(recipe.sh_interval * scale * k) for k in range(1, config.sh_degree + 1)]
    evaluate = {max(1, round(steps * k / config.evaluations)) for k in range(1, config.evaluations + 1)}
    return Timetable(
        tuple(max(1, step) for step in sh), densify, reset, tuple(sorted(evaluate)), round(config.coarse * steps)
    )


def _check_types(config: FitConfig | Recipe) -> None:
    """Raise a ValueError where an entry is not of its default's kind: a whole number, a finite number or a text."""
    for entry in fields(config):
        value, default = getattr(config, entry.name), entry.default
        if isinstance(default, float):
            is_right = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300
        elif isinstance(default, int):
            is_right = type(value) is int and abs(value) < 2**62
        else:
            is_right = not isinstance(default, str) or isinstance(value, str)
        if not is_right:
            raise ValueError(f"{entry.name}: expected a value like {default!r}, got {str(value)[:60]!r}")


# A third of the default's time for the same PSNR of test views, see docs/error-and-time.md: half the steps at twice the
# rates, nine in ten of them on a quarter of the pixels, and Gaussians that come as they are needed.
FAST = FitConfig(
    steps=1000,
    coarse=0.9,
    max_gaussians=14_000,
    growth=0.8,
    recipe=Recipe(lr_means=3e-4, lr_scales=0.01, lr_sh_dc=0.005, lr_sh_rest=2.5e-4),
)
