"""What was decided about a fit, from its photos before it and from its renders after it.

Typed here; plain values only in files (metrics.json, checkpoints).
"""

from dataclasses import asdict, dataclass
from typing import Any, Self

from kgs._support.errors import ArgumentError


@dataclass(frozen=True)
class DegreeDecision:
    """The degree of the harmonics, see :mod:`kgs.fit.sh_degree`.

    Args:
        chosen: the degree.
        by: "rule" or "photos".
        why: of a rule.
        over: the other degree, where photos decided.
        gain: dB that harmonics can add to a fit of 25 dB, where photos decided.
        n: the number of patches, where photos decided.
    """

    chosen: int
    by: str
    why: str | None = None
    over: int | None = None
    gain: float | None = None
    n: int | None = None


@dataclass(frozen=True)
class OverlapDecision:
    """The number of steps and the drop rate, see :mod:`kgs.fit.overlap`.

    Args:
        views_per_patch: views that show a patch of surface, in the mean.
        views_per_pair: views that show both of two patches, in the mean.
        patches: how many there are.
        steps: as decided; None: as given.
        drop: the final rate, as decided; None: as given.
    """

    views_per_patch: float
    views_per_pair: float
    patches: int
    steps: int | None = None
    drop: float | None = None


@dataclass(frozen=True)
class ExposureDecision:
    """The gains of the training photos, see :mod:`kgs.fit.exposure`.

    Args:
        gains: three numbers for each training view, with a geometric mean of 1.
        left: the share of the patches' differences that they leave.
        n: the number of patches.
    """

    gains: list[list[float]]
    left: float
    n: int


@dataclass(frozen=True)
class PruningDecision:
    """What was kept after the fit, see :mod:`kgs.fit.pruning`.

    Args:
        fitted: the number of Gaussians before.
        kept: and after.
        weight: the limit on what a Gaussian contributes, in pixels; -1 keeps all.
        sh_degree: of the harmonics that are kept.
    """

    fitted: int
    kept: int
    weight: float
    sh_degree: int


@dataclass(frozen=True)
class Decisions:
    """All that was decided about a fit, with None for what was given."""

    sh_degree: DegreeDecision | None = None
    overlap: OverlapDecision | None = None
    exposure: ExposureDecision | None = None
    gaussians: PruningDecision | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a file, without those that are None."""
        parts = {name: part for name, part in asdict(self).items() if part is not None}
        return {name: {key: x for key, x in part.items() if x is not None} for name, part in parts.items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """The inverse of :meth:`to_dict`. A ValueError about "decisions" for other values."""
        try:
            return cls(**{name: _KINDS[name](**part) for name, part in values.items()})
        except (AttributeError, KeyError, TypeError) as error:
            raise ArgumentError("decisions", "those of a fit", str(error)) from error


_KINDS: dict[str, Any] = {
    "sh_degree": DegreeDecision,
    "overlap": OverlapDecision,
    "exposure": ExposureDecision,
    "gaussians": PruningDecision,
}
