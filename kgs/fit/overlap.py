"""Decides before a fit, by how many photos show the same surface, its number of steps and the rate of dropping.

The more photos show a patch of surface, the longer a fit goes on to gain. Dropping is for the opposite case: a
Gaussian can fit the few photos that show it and be wrong in all other views, and dropping makes such Gaussians rarer.
But it blurs, and where most photos show the same surface it gains nothing. The patches are those of
:class:`kgs.init_points.patches.PatchColors`.
"""

from dataclasses import replace
from typing import Any, NamedTuple, Self

from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES, PatchColors

from .config import DROP
from .decisions import OverlapDecision
from .plan import FEW, Plan

STEPS_OF_A_PHOTO = 275  # steps for each photo beyond the third that shows a patch of surface
MAX_STEPS = 1400
FEW_TOGETHER = 3.0  # photos that show two patches at once: up to so many the rate is `DROP`
MANY_TOGETHER = 5.0  # from so many on nothing is dropped


class Overlap(NamedTuple):
    """How many photos show the same patches of surface.

    Args:
        views_per_patch: how many show a patch and agree on its depth, in the mean over the patches.
        views_per_pair: how many show both of two patches, in the mean over all pairs of patches.
    """

    views_per_patch: float
    views_per_pair: float

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
        The plan with a rate, and with a number of steps. If the patches decided, `decisions.overlap` says by what.
        Without patches the rate is `DROP`, and the fit has the usual length.
    """
    is_open = [name for name in ("steps", "drop") if getattr(plan.config, name) is None]
    if not is_open:
        return plan
    patches = points.patches
    if patches is None or len(patches) < MIN_PATCHES:
        usual = {"steps": plan.schedule.steps, "drop": DROP}
        return plan.decided({name: usual[name] for name in is_open})
    overlap = Overlap.of(patches)
    chosen: dict[str, Any] = {
        "steps": steps_for(overlap.views_per_patch),
        "drop": drop_rate_for(overlap.views_per_pair),
    }
    entries = {name: chosen[name] for name in is_open}
    decision = OverlapDecision(
        views_per_patch=round(overlap.views_per_patch, 2),
        views_per_pair=round(overlap.views_per_pair, 2),
        patches=len(patches),
    )
    return plan.decided(entries, overlap=replace(decision, **entries))


def steps_for(views_per_patch: float) -> int:
    """The number of steps where so many photos show a patch, a multiple of 50; of three as in fits to three."""
    steps = FEW.steps + STEPS_OF_A_PHOTO * (views_per_patch - 3)
    return min(max(50 * round(steps / 50), FEW.steps), MAX_STEPS)


def drop_rate_for(views_per_pair: float) -> float:
    """The final rate of dropping where so many photos show two patches at once, to two decimals."""
    share = (MANY_TOGETHER - views_per_pair) / (MANY_TOGETHER - FEW_TOGETHER)
    return round(DROP * min(max(share, 0.0), 1.0), 2)
