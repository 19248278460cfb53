"""Decides before a fit whether Gaussians are dropped: not where many photos show each place.

Dropping helps where a Gaussian can please the few photos that show it and be wrong for all others. Patches of surface
say how many these are: see :class:`kgs.init_points.patches.PatchColors`.
"""

from dataclasses import replace

from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES

from .config import DROP
from .plan import Plan

MOST_PHOTOS = 6.5  # that show a patch, in the mean over the patches, for dropping to be used


def decide_drop(plan: Plan, points: InitialPoints) -> Plan:
    """Decide the final rate of dropping, if the plan leaves it open.

    Args:
        plan: of the fit.
        points: its initial points; without patches Gaussians are dropped.

    Returns:
        The plan with a rate. If the patches decided, its `needs` have under "drop" a dict: "chosen", "photos" (how many
        show a patch and agree on its depth, in the mean) and "n", the number of patches.
    """
    if plan.config.drop is not None:
        return plan
    if points.patches is None or len(points.patches) < MIN_PATCHES:
        return replace(plan, config=replace(plan.config, drop=DROP))
    photos = float(points.patches.visible.double().sum(1).mean())
    chosen = DROP if photos <= MOST_PHOTOS else 0.0
    found = {"chosen": chosen, "photos": round(photos, 2), "n": len(points.patches)}
    return replace(plan, config=replace(plan.config, drop=chosen), needs={**plan.needs, "drop": found})
