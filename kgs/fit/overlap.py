"""Decides before a fit, by how many photos show the same surface, its number of steps and the rate of dropping.

The more photos show a patch of surface, the longer a fit goes on to gain. Dropping is for the opposite case: a
Gaussian can fit the few photos that show it and be wrong in all other views, and dropping makes such Gaussians rarer.
But it blurs, and where most photos show the same surface it gains nothing. The patches are those of
:class:`kgs.init_points.patches.PatchColors`.
"""

from typing import NamedTuple, Self

from kgs.init_points.patches import MIN_PATCHES, PatchColors

from .config import DROP
from .decisions import OverlapDecision


class Usual(NamedTuple):
    """The length of a fit, and how fast opacities fade: with more views, what only some show is seen less often."""

    steps: int
    opacity_decay: float


FEW = Usual(900, 0.9925)  # of a fit to up to three training views
MANY = Usual(1100, 0.995)  # of a fit to more, where nothing tells how many of them show each patch
FADING_STEPS = 1000  # up to so many the decay of few views is used: in longer fits too much would fade
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


def decide_by_overlap(
    patches: PatchColors | None, steps: int | None, drop: float | None
) -> tuple[int, float, OverlapDecision | None]:
    """The number of steps and the final rate of dropping, and what decided them.

    Args:
        patches: of the initial points. With too few of them a fit has the usual length, and the rate is `DROP`.
        steps: as given; None: open.
        drop: as given; None: open.
    """
    if steps is not None and drop is not None:
        return steps, drop, None
    if patches is None or len(patches) < MIN_PATCHES:
        return MANY.steps if steps is None else steps, DROP if drop is None else drop, None
    overlap = Overlap.of(patches)
    chosen_steps = steps_for(overlap.views_per_patch) if steps is None else steps
    chosen_drop = drop_rate_for(overlap.views_per_pair) if drop is None else drop
    decision = OverlapDecision(
        views_per_patch=round(overlap.views_per_patch, 2),
        views_per_pair=round(overlap.views_per_pair, 2),
        patches=len(patches),
        steps=chosen_steps if steps is None else None,
        drop=chosen_drop if drop is None else None,
    )
    return chosen_steps, chosen_drop, decision


def usual_decay(is_few: bool, steps: int) -> float:
    """The factor on opacities in a fit of so many steps, to a few training views or more."""
    return (FEW if is_few and steps <= FADING_STEPS else MANY).opacity_decay


def steps_for(views_per_patch: float) -> int:
    """The number of steps where so many photos show a patch, a multiple of 50, and of three as in fits to three."""
    steps = FEW.steps + STEPS_OF_A_PHOTO * (views_per_patch - 3)
    return min(max(50 * round(steps / 50), FEW.steps), MAX_STEPS)


def drop_rate_for(views_per_pair: float) -> float:
    """The final rate of dropping where so many photos show two patches at once, to two decimals."""
    share = (MANY_TOGETHER - views_per_pair) / (MANY_TOGETHER - FEW_TOGETHER)
    return round(DROP * min(max(share, 0.0), 1.0), 2)
