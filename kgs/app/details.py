"""What `--detail` sets together: the size of the photos, steps and initial points."""

from typing import Any, NamedTuple


class Detail(NamedTuple):
    """How much detail a fit is to show: the size of the photos, and the entries of `FitConfig` that suit it."""

    size: int  # pixels of the longer side
    entries: dict[str, Any]


# low: fewer steps, a third of them on a quarter of the pixels, and fewer points. high: more pixels and points; half of
# the steps use a quarter of the pixels.
DETAILS = {
    "low": Detail(378, {"steps": 700, "coarse": 0.3, "init_points": 12_000}),
    "normal": Detail(800, {}),
    "high": Detail(1000, {"coarse": 0.5, "init_points": 90_000}),
}
COARSE = 0.5  # of unposed photos at the size of normal detail
