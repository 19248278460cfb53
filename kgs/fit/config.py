"""All settings of a fit as frozen dataclasses; values are checked here, and only here.

Source: the official release of "DropGaussian" (CVPR 2025) for the recipe of the presets `paper` and `plain`, which is
that of Kerbl et al. 2023 with another densification threshold and without pruning by size. The default does not reset
opacities, and has harmonics only if the training views need them; docs/recipe.md says why.
"""

from dataclasses import asdict, dataclass, field, fields, replace
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self, get_args, get_origin, get_type_hints

from kgs._support.errors import ArgumentError, quoted


class _Range(NamedTuple):
    """The interval of valid numbers. Of its `ends`, "[" and "]" include a limit, "(" and ")" exclude it."""

    low: float
    high: float = 1e300
    ends: str = "[]"

    def holds(self, value: float) -> bool:
        is_excluded = (value == self.low and self.ends[0] != "[") or (value == self.high and self.ends[1] != "]")
        return self.low <= value <= self.high and not is_excluded

    def __str__(self) -> str:
        if self.high == 1e300:
            return f"{'of at least' if self.ends[0] == '[' else 'above'} {self.low:g}"
        return f"in {self.ends[0]}{self.low:.12g}, {self.high:.12g}{self.ends[1]}"


_Steps = Annotated[int, _Range(1, 10_000_000)]
_Count = Annotated[int, _Range(0, 10_000_000)]
_Positive = Annotated[float, _Range(0, ends="(]")]
_Weight = Annotated[float, _Range(0)]
_Share = Annotated[float, _Range(0, 1)]
_Rate = Annotated[float, _Range(0, 1, "[)")]
_Degree = Annotated[int, _Range(0, 3)]
_Decay = Annotated[float, _Range(0, 1, "(]")]
Backend = Literal["auto", "torch", "numba", "triton"]
Background = Literal["black", "white"]

DROP = 0.3  # final rate of dropping where few photos show the same surface


@dataclass(frozen=True)
class Recipe:
    """The training recipe of a fit of `steps` steps.

    A fit of another length scales the counts and keeps the rates.

    Args:
        steps: steps of the whole recipe, counted from 1; each one renders one training view.
        lr_means: learning rate of the centres at the start, times the extent of the training cameras.
        lr_means_final: the same at the end, reached log-linearly.
        lr_sh_dc: learning rate of the colour of degree 0, which does not depend on the direction.
        lr_sh_rest: learning rate of the higher harmonics.
        lr_opacity: learning rate of the opacity logits.
        lr_scales: learning rate of the logarithms of the scales.
        lr_quats: learning rate of the quaternions.
        adam_eps: Adam's epsilon; torch's default would stall the small gradients.
        sh_interval: steps after which one more degree of the harmonics is switched on.
        dssim_weight: loss = L1 + dssim_weight (1 - SSIM).
        densify_from: no densification up to this step.
        densify_interval: steps between two densifications.
        grad_threshold: least mean gradient, in normalised device coordinates, of a Gaussian that is densified.
        absgrad: False: gradients of pixels are added with their signs, instead of their absolute values (AbsGS), which
            are about four times as large.
        percent_dense: largest scale, as a fraction of the extent, of a Gaussian that is cloned; larger ones are split.
        error_points: share of the number of Gaussians that each densification in the first 60 % of the steps adds, at
            dense points that are left, where the error is large; in [0, 1]. 0: none.
        prune_opacity: Gaussians below this opacity are removed.
        opacity_decay: factor on all opacities after each step, in (0, 1]; it does not depend on the number of steps.
            None: 0.9925 for up to three training views and 1000 steps, else 0.995.
        decay_from: share of the steps after which this decay begins, in [0, 1].
        haze_interval: steps between two looks for Gaussians that veil a training view, whose opacities are halved; at
            least 50, and none in the last tenth of the steps. 0: none at all.
        reset_interval: steps between two resets of all opacities; 0: none.
        reset_opacity: a reset lowers larger opacities to this; with resets more than `prune_opacity`.
        reset_recovery: a reset is skipped if fewer steps than this follow before the next one or the end.
        alpha_threshold: alphas below it are skipped in training, in [0, 1); in all other renders, those below 1 / 255.
        threshold_until: share of the steps after which training skips no more than all other renders do, in [0, 1].
        near_plane: distance of the near plane, relative to the 1st percentile of the initial points' depths.
    """

    steps: _Steps = 10_000
    lr_means: _Positive = 1.6e-4
    lr_means_final: _Positive = 1.6e-6
    lr_sh_dc: _Weight = 2.5e-3
    lr_sh_rest: _Weight = 1.25e-4
    lr_opacity: _Weight = 0.05
    lr_scales: _Weight = 0.02
    lr_quats: _Weight = 0.004
    adam_eps: _Weight = 1e-15
    sh_interval: _Steps = 1000
    dssim_weight: _Weight = 0.4
    densify_from: _Count = 500
    densify_interval: _Steps = 100
    grad_threshold: _Weight = 2e-3
    absgrad: bool = True
    percent_dense: _Positive = 0.01
    error_points: _Share = 0.03
    prune_opacity: _Share = 0.02
    opacity_decay: Annotated[float | None, _Range(0, 1, "(]")] = None
    decay_from: _Share = 0.05
    haze_interval: _Count = 1000
    reset_interval: _Count = 0
    reset_opacity: Annotated[float, _Range(0, 1, "()")] = 0.01
    reset_recovery: _Count = 300
    alpha_threshold: Annotated[float, _Range(0, 1, "[)")] = 2 / 255
    threshold_until: _Share = 2 / 3
    near_plane: _Positive = 0.05

    def __post_init__(self) -> None:
        _check(self)
        if self.reset_interval and self.reset_opacity <= self.prune_opacity:
            expected = f"above prune_opacity ({self.prune_opacity:g}), or a reset would remove all Gaussians"
            raise ArgumentError("reset_opacity", f"a number {expected}", f"{self.reset_opacity:g}")


@dataclass(frozen=True)
class FitConfig:
    """The settings of one fit. NumPy's numbers are accepted and become Python's.

    `fit_scene` and the command use all entries. A `Trainer` is given its initial points and removes nothing after the
    last step: it ignores init, init_file, init_points, draw and prune. :func:`kgs.fit.plan.make_plan` settles the
    entries of None, and :mod:`kgs.fit.overlap` has its numbers of steps and drop. Only the command takes the device
    auto, its default: a GPU if kgs has kernels for it that pass their check, else the CPU.

    Args:
        steps: number of training steps, to which the recipe's counts are scaled. Unless given: 900 for up to three
            views; 900 to 1400 for more, by how many photos show a patch of surface.
        drop: final rate of DropGaussian, in [0, 1); 0 leaves the layer out. Unless given: 0.3, and less, down to 0,
            where many photos show the same surface.
        drop_schedule: linear: the rate grows with the steps, as in the paper. constant: dropout at that rate.
        no_drop_steps: number of last steps in which no Gaussian is dropped, at most a tenth of all.
        sh_degree: degree of the view-dependent colour (spherical harmonics), 0 to 3. Unless given: 3
            if the colours of the training views depend on the direction, else 0.
        exposure: whether each training photo has a gain in each channel, which is estimated before the fit and held.
            auto: where photos differ by a factor of 1.3 or more, and gains explain it. each: always, if the initial
            points are dense. same: never.
        refine_poses: optimise the poses of the training cameras too, for poses that are half a degree or more off;
            accurate ones get slightly worse. Their mean and spread stay.
        coarse: half-resolution warm-up: share of the steps, from the start, that use the training views at half the
            width; in [0, 1]. Unless given: 0, and half of them for unposed photos at the size that kgs fit chooses.
        seed: of everything random: initial points, order of views, backgrounds, splits and drop masks.
        init: kind of initial points. dense: points of depth maps, made from the training images by a plane sweep in
            some seconds per view. sift: points of matched keypoints. random: random points in the space that at least
            two images see. scene: the random points that Blender's layout prescribes. model-points: the points of a
            COLMAP model, which was refined with the test views too. file: the points of a file.
        init_file: a point cloud (PLY, OBJ, ...) for the init "file".
        init_points: number of points of the init random, and largest number of dense; at least 4. Unless given: of
            dense one for every 3 pixels whose depth two views agree on, 30 000 to 60 000, or to 90 000 with up to
            three training views; of random 30 000.
        draw: how dense points are chosen. spread: one from each of as many equal cells of the images. uniform: each
            with the same probability.
        training_background: random: another colour in each step, so that a hole in the splat cannot pass for a surface
            of the background's colour. scene: the background of the scene, as in test views.
        max_gaussians: largest number of Gaussians, at which densification stops. Unless given: 10 per step, and at
            least 1.5 times the number of initial points.
        prune: False: Gaussians that no training view shows stay, and so do harmonics that change no image.
        max_bytes: bound on the working memory of a render, in bytes; it changes results only by rounding. Unless given:
            that of `kgs.RasterOptions`.
        evaluations: how often the PSNR curve is measured, the last time at the end.
        device: cpu, cuda, ... auto: a GPU if one is of use.
        backend: numba: compiled, several times faster than torch, only on a CPU. triton: compiled, only on a GPU. auto:
            the one of these that is installed, else torch.
        recipe: all other numbers, a `kgs.fit.config.Recipe`.

    Raises:
        ValueError: an entry is out of range or of the wrong type; the message begins with its name.
    """

    steps: Annotated[int | None, _Range(1, 10_000_000)] = None
    drop: Annotated[float | None, _Range(0, 1, "[)")] = None
    drop_schedule: Literal["linear", "constant"] = "linear"
    no_drop_steps: _Count = 50
    sh_degree: Annotated[int | None, _Range(0, 3)] = None
    exposure: Literal["auto", "each", "same"] = "auto"
    refine_poses: bool = False
    coarse: Annotated[float | None, _Range(0, 1)] = None
    seed: Annotated[int, _Range(-(2**59), 2**59, "()")] = 0  # ten times a seed has to fit torch's 64 bits
    init: Literal["dense", "sift", "random", "scene", "model-points", "file"] = "dense"
    init_file: Path | None = None
    init_points: Annotated[int | None, _Range(4, 10**9)] = None
    draw: Literal["spread", "uniform"] = "spread"
    training_background: Literal["random", "scene"] = "random"
    max_gaussians: Annotated[int | None, _Range(1, 10**9)] = None
    prune: bool = True
    max_bytes: Annotated[int | None, _Range(1, 2**62)] = None
    evaluations: _Steps = 8
    device: str = "cpu"
    backend: Backend = "auto"
    recipe: Recipe = field(default_factory=Recipe)

    def __post_init__(self) -> None:
        _check(self)
        if (self.init == "file") != (self.init_file is not None):
            wanted = "a point cloud for" if self.init == "file" else "none without"
            raise ArgumentError("init_file", f'{wanted} the init "file"', self.init_file)

    def to_dict(self) -> dict[str, Any]:
        """The entries as plain values, for JSON and checkpoints."""
        return asdict(self) | {"init_file": None if self.init_file is None else str(self.init_file)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """The inverse of `to_dict`. A ValueError if an entry is unknown or out of range."""
        recipe = values.get("recipe", {}) if isinstance(values, dict) else None
        if not isinstance(recipe, dict):
            raise ArgumentError("values", f"the entries of a {cls.__name__}", quoted(values))
        kind = get_type_hints(cls)["recipe"]
        for owner, entries in ((cls, values), (kind, recipe)):
            if unknown := sorted({*map(str, entries)} - {entry.name for entry in fields(owner)}):
                raise ArgumentError("values", f"the entries of a {owner.__name__}", quoted(unknown[0]))
        return cls(**{**values, "recipe": kind(**recipe)})


@dataclass(frozen=True, kw_only=True)
class SettledRecipe(Recipe):
    """A recipe that leaves nothing open."""

    opacity_decay: _Decay


@dataclass(frozen=True, kw_only=True)
class Settings(FitConfig):
    """The configuration of a fit once it is settled: a training step reads numbers alone."""

    steps: _Steps
    drop: _Rate
    sh_degree: _Degree
    coarse: _Share
    recipe: SettledRecipe

    @classmethod
    def of(cls, config: FitConfig, *, opacity_decay: float, **entries: Any) -> Self:
        """The settings of a configuration, with these entries in place of its own."""
        recipe = SettledRecipe(**vars(config.recipe) | {"opacity_decay": opacity_decay})
        return cls(**vars(config) | entries | {"recipe": recipe})

    def of_resumed(self, config: FitConfig) -> Self:
        """The settings of a fit that goes on: those of a configuration, and these where it leaves something open."""
        names = ("steps", "drop", "sh_degree", "coarse")
        entries = {name: getattr(self, name) for name in names if getattr(config, name) is None}
        decay = config.recipe.opacity_decay
        return self.of(config, opacity_decay=self.recipe.opacity_decay if decay is None else decay, **entries)


def min_side(config: FitConfig, lpips: bool) -> int:
    """The least pixels of the shorter side of photos in a fit, whose result is measured with or without LPIPS."""
    return max(16 if lpips else 6, 12 if config.coarse else 6)


def _check(config: FitConfig | Recipe) -> None:
    """Check each entry against its annotation, and make NumPy's numbers Python's, and text a path."""
    hints = get_type_hints(type(config), include_extras=True)
    for entry in fields(config):
        value = getattr(config, entry.name)
        hint = hints[entry.name]
        kinds = get_args(get_args(hint)[0] if get_origin(hint) is Annotated else hint)
        if value is None and type(None) in kinds:
            continue
        converted, expected = _convert(value, hint)
        if converted is None:
            raise ArgumentError(entry.name, expected, quoted(value))
        object.__setattr__(config, entry.name, converted)


def _convert(value: Any, hint: Any) -> tuple[Any, str]:
    """The value in the type of its annotation, or None where it is wrong, and what is expected, in words."""
    if get_origin(hint) is Literal:
        return value if isinstance(value, str) and value in get_args(hint) else None, f"one of {list(get_args(hint))}"
    if hint == Path | None:
        is_path = isinstance(value, (str, PathLike)) and str(value)
        return (value if isinstance(value, Path) else Path(value)) if is_path else None, "a path"
    if get_origin(hint) is not Annotated:
        return value if isinstance(value, hint) else None, "a name" if hint is str else f"a {hint.__name__}"
    kind, limits = get_args(hint)
    is_real = float in (kind, *get_args(kind))
    expected = f"a {'finite' if is_real else 'whole'} number {limits}"
    is_number = isinstance(value, Real if is_real else Integral) and not isinstance(value, bool)
    if not (is_number and limits.holds(value)):
        return None, expected
    return (float(value) if is_real else int(value)), expected


# `paper`: the paper's rule and recipe, with its counts scaled. `plain`: the same without dropping.
PAPER = FitConfig(
    steps=2000,
    drop=0.2,
    no_drop_steps=0,
    sh_degree=3,
    exposure="same",
    coarse=0.0,
    init_points=10_000,
    draw="uniform",
    training_background="scene",
    prune=False,
    recipe=Recipe(
        lr_scales=0.005,
        lr_quats=0.001,
        dssim_weight=0.2,
        grad_threshold=5e-4,
        absgrad=False,
        error_points=0.0,
        prune_opacity=0.005,
        opacity_decay=1.0,
        haze_interval=0,
        reset_interval=3000,
        alpha_threshold=1 / 255,
    ),
)
PRESETS = {"auto": FitConfig(), "paper": PAPER, "plain": replace(PAPER, drop=0.0)}
