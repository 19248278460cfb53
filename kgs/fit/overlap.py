"""Decides before a fit, by how many photos show each place, its number of steps and the rate of dropping.

A Gaussian can fit the few photos that show it and be wrong in all other views. Dropping makes such Gaussians rarer, and
more steps make them more wrong. Where many photos show each place, dropping blurs and more steps add detail. Patches of
surface tell how many photos show one: see :class:`kgs.init_points.patches.PatchColors`.
"""

from dataclasses import replace

from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES

from .config import DROP
from .plan import FEW, Plan, timetable

FEW_PHOTOS = 3.0  # that show a patch, in the mean over the patches: up to them the rate is `DROP`
MANY_PHOTOS = 6.5  # from them on nothing is dropped
STEPS_OF_A_PHOTO = 275  # steps for each photo more than `FEW_PHOTOS` that shows a patch
MOST_STEPS = 2000


def decide_by_overlap(plan: Plan, points: InitialPoints) -> Plan:
    """Decide the number of steps and the final rate of dropping, where the plan leaves them open.

    Args:
        plan: of the fit.
        points: its initial points.

    Returns:
        The plan with a rate, and with a number of steps. If the patches decided, its `needs` have under "overlap" a
        dict: "photos" (how many show a patch and agree on its depth, in the mean), "n" (the number of patches), and
        "steps" and "drop", those of the two that were decided. Without patches the rate is `DROP`.
    """
    config = plan.config
    if config.steps is not None and config.drop is not None:
        return plan
    if points.patches is None or len(points.patches) < MIN_PATCHES:
        return _with(plan, {"steps": plan.times.steps, "drop": DROP})
    photos = float(points.patches.visible.double().sum(1).mean())
    decided = _with(plan, {"steps": steps_for(photos), "drop": drop_rate_for(photos)})
    names = [name for name in ("steps", "drop") if getattr(config, name) is None]
    found = {"photos": round(photos, 2), "n": len(points.patches)}
    found |= {name: getattr(decided.config, name) for name in names}
    return replace(decided, needs={**plan.needs, "overlap": found})


def steps_for(photos: float) -> int:
    """The number of steps where so many photos show a patch in the mean, a multiple of 50."""
    steps = FEW.steps + STEPS_OF_A_PHOTO * (photos - FEW_PHOTOS)
    return min(50 * round(steps / 50), MOST_STEPS)


def drop_rate_for(photos: float) -> float:
    """The final rate of dropping where so many photos show a patch in the mean, with two decimals."""
    share = (MANY_PHOTOS - photos) / (MANY_PHOTOS - FEW_PHOTOS)
    return round(DROP * min(max(share, 0.0), 1.0), 2)


def _with(plan: Plan, values: dict[str, float]) -> Plan:
    """The plan with these settings, where it leaves them open."""
    chosen = {name: value for name, value in values.items() if getattr(plan.config, name) is None}
    config = replace(plan.config, **chosen)
    return replace(plan, config=config, times=timetable(config))
