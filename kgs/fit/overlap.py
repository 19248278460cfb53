"""Decides before a fit, by how many photos show the same places, its number of steps and the rate of dropping.

The more photos show a place, the longer a fit goes on to gain. Dropping is for the opposite case: a Gaussian can fit
the few photos that show it and be wrong in all other views, and dropping makes such Gaussians rarer. But it blurs, and
where most photos show the same places it gains nothing. Patches of surface tell which photos show what: see
:class:`kgs.init_points.patches.PatchColors`.
"""

from dataclasses import replace
from typing import Any, NamedTuple, Self

from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES, PatchColors

from .config import DROP
from .plan import FEW, Plan, timetable

STEPS_OF_A_PHOTO = 275  # steps for each photo beyond the third that shows a place
MOST_STEPS = 1800
FEW_TOGETHER = 3.0  # photos that show two places at once: up to so many the rate is `DROP`
MANY_TOGETHER = 5.0  # from so many on nothing is dropped


class Overlap(NamedTuple):
    """How many photos show the same places.

    Args:
        photos: that show a patch and agree on its depth, in the mean over the patches.
        together: that show both of two patches, in the mean over all pairs of patches.
    """

    photos: float
    together: float

    @classmethod
    def of(cls, patches: PatchColors) -> Self:
        """With f_v the share of the patches that photo v shows, the sums of f_v and of f_v squared."""
        shares = patches.visible.double().mean(0)
        return cls(float(shares.sum()), float(shares.square().sum()))


def decide_by_overlap(plan: Plan, points: InitialPoints) -> Plan:
    """Decide the number of steps and the final rate of dropping, where the plan leaves them open.

    Args:
        plan: of the fit.
        points: its initial points.

    Returns:
        The plan with a rate, and with a number of steps. If the patches decided, its `needs` have under "overlap" a
        dict: "photos" and "together" as in :class:`Overlap`, "n" (the number of patches), and of "steps" and "drop"
        those that were decided. Without patches the rate is `DROP`, and the fit has the usual length.
    """
    is_open = [name for name in ("steps", "drop") if getattr(plan.config, name) is None]
    if not is_open:
        return plan
    patches = points.patches
    if patches is None or len(patches) < MIN_PATCHES:
        return _with(plan, {"steps": plan.times.steps, "drop": DROP}, is_open)
    overlap = Overlap.of(patches)
    plan = _with(plan, {"steps": steps_for(overlap.photos), "drop": drop_rate_for(overlap.together)}, is_open)
    found = {name: round(number, 2) for name, number in overlap._asdict().items()} | {"n": len(patches)}
    found |= {name: getattr(plan.config, name) for name in is_open}
    return replace(plan, needs={**plan.needs, "overlap": found})


def steps_for(photos: float) -> int:
    """The number of steps where so many photos show a place, a multiple of 50."""
    steps = FEW.steps + STEPS_OF_A_PHOTO * (photos - 3)
    return min(max(50 * round(steps / 50), FEW.steps), MOST_STEPS)


def drop_rate_for(together: float) -> float:
    """The final rate of dropping where so many photos show two places at once, to two decimals."""
    share = (MANY_TOGETHER - together) / (MANY_TOGETHER - FEW_TOGETHER)
    return round(DROP * min(max(share, 0.0), 1.0), 2)


def _with(plan: Plan, values: dict[str, Any], names: list[str]) -> Plan:
    """The plan with these of the values in its settings."""
    config = replace(plan.config, **{name: values[name] for name in names})
    return replace(plan, config=config, times=timetable(config))
