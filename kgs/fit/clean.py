"""Removes floaters, oversized and elongated Gaussians from a splat, as far as the training views do not need them.

Few photos leave much of a splat undetermined: a Gaussian that one photo alone shows can stand anywhere on its ray, and
one that is long or large enough shows from elsewhere what it never had to show. From the cameras of the photos such
Gaussians look right; from beside them they are streaks and fog.

Source: the squared change of an image without one Gaussian is a diagonal entry of J^T J, which random signs estimate
(M. F. Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1990).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs._support.errors import ArgumentError
from kgs._support.progress import ProgressBar, silent
from kgs.geometry.cameras import project, to
from kgs.geometry.multiview import nearest_pixels, typical_depths
from kgs.geometry.rigs import camera_centers
from kgs.geometry.spacing import NEIGHBOURS, log_spacing
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .fit import Fit
from .pruning import psnr_per_view
from .view_renders import ViewRenders

KINDS = ("oversized", "elongated", "floaters")
MAX_STRENGTH = 100.0
TOLERANCE = 0.05  # dB that a training view may lose at strength 1
# Limits at strength 1.
OVERSIZED = 30.0  # largest axis, over what is typical at its distance from the middle
ELONGATED = 10.0  # largest axis over the second
LONG = 10.0  # largest axis of an elongated one, over what is typical there
SEEN_THROUGH = 0.2  # how much farther, over its depth, the view shows something behind it
CONFIRMED = 0.05  # how much a depth and that of the view differ at most
NEAR = 0.3  # distance to a camera, over the 1st percentile of depths
ISOLATED = 10.0  # distance to the nearest three, over what is typical there
APART = 3.0  # the same, over its own largest axis
_SIGNS = 8  # images of random signs for each view
_PARTS = 200  # the search for the number to remove ends at a 200th of the candidates


@dataclass(frozen=True, eq=False)
class Artifacts:
    """Which Gaussians of a splat are oversized, elongated or floaters. One may be several.

    Args:
        oversized: bool `(N,)`.
        elongated: bool `(N,)`.
        floaters: bool `(N,)`.
    """

    oversized: Tensor
    elongated: Tensor
    floaters: Tensor

    @property
    def any(self) -> Tensor:
        """Those of at least one kind, bool `(N,)`."""
        return self.oversized | self.elongated | self.floaters

    def counts(self, rows: Tensor) -> dict[str, int]:
        """How many of the Gaussians at `rows`, bool `(N,)`, are of each kind. One of several counts for the first."""
        found = dict[str, int]()
        for kind in KINDS:
            mask: Tensor = getattr(self, kind)
            found[kind] = int((mask & rows).sum())
            rows = rows & ~mask
        return found


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A fit without artifacts, and what was removed.

    Args:
        fit: with the Gaussians that are left.
        removed: how many were removed, by kind.
        needed: how many artifacts stay because a training view needs them.
        before: the PSNR of each training view before, in dB; `kgs.metrics.evaluate.BEST` stands for infinity.
        after: the same after.
    """

    fit: Fit
    removed: dict[str, int]
    needed: int
    before: tuple[float, ...]
    after: tuple[float, ...]


@torch.no_grad()
def find_artifacts(
    model: GaussianModel,
    strength: float = 1.0,
    cameras: PinholeCamera | None = None,
    depths: Sequence[Tensor] = (),
) -> Artifacts:
    """The floaters, the oversized and the elongated Gaussians of a model.

    A size or spacing is typical if it is the median over the splat; at k times the median distance from the middle (the
    median of the centres), k > 1, it is k times the median, because a splat is coarser far out. With s the root of the
    strength,

    - an oversized Gaussian has a largest axis of more than `OVERSIZED` / s times the typical one, and k times that far
      out, where a few large ones are the background,
    - an elongated one has a largest axis of more than `ELONGATED` / s times its second, and more than `LONG` / s times
      the typical one: short ones draw the edges of things,
    - a floater is not confirmed by two cameras, and is seen through by one, or near one, or isolated. A camera confirms
      a Gaussian whose centre it has in its image, at a depth within `CONFIRMED` of its median depth there; it sees
      through it if its median depth is more than `SEEN_THROUGH` / s farther. Near is closer to the centre of a camera
      than `NEAR` s times the 1st percentile of the depths of the confirmed. A Gaussian is isolated if the root mean
      squared distance to its three nearest is more than `ISOLATED` / s times the typical one, and more than `APART` /
      s times its own largest axis.

    Convention:
        Depth is z in the camera's frame (OpenCV axes), in world units; integer pixel centres.

    Args:
        model: N Gaussians.
        strength: above 0, at most `MAX_STRENGTH`; 1 is cautious.
        cameras: C cameras in the frame of the Gaussians, those of the photos; None: floaters are the isolated alone.
        depths: of each camera the median depth of the splat, each `(H, W)`, 0 where there is nothing.

    Raises:
        ValueError: the strength is out of range, or there is not one depth for each camera.
    """
    check_strength(strength)
    if len(depths) != (0 if cameras is None else cameras.batch_size):
        expected = 0 if cameras is None else cameras.batch_size
        raise ArgumentError("depths", f"one for each of {expected} cameras", len(depths))
    root = math.sqrt(strength)
    means = model.means.detach().double().cpu()
    axes = model.log_scales.detach().double().cpu().exp().sort(dim=1, descending=True).values
    largest = axes[:, 0]
    farther = _farther(means)
    relative = largest / (_median(largest) * farther)
    oversized = relative > OVERSIZED / root * farther
    elongated = (largest > ELONGATED / root * axes[:, 1]) & (relative > LONG / root)
    spacing = _spacing(means)
    floaters = (spacing > ISOLATED / root * _median(spacing) * farther) & (spacing > APART / root * largest)
    if cameras is not None:
        confirmed, seen_through = _evidence(means, cameras, depths, SEEN_THROUGH / root)
        floaters |= (seen_through > 0) | _near(means, cameras, confirmed >= 2, NEAR * root)
        floaters &= confirmed < 2
    device = model.means.device
    return Artifacts(oversized.to(device), elongated.to(device), floaters.to(device))


def clean(fit: Fit, strength: float = 1.0, bar: ProgressBar = silent) -> Cleaned:
    """The fit without the floaters, oversized and elongated Gaussians that its training views can spare.

    The candidates are those of :func:`find_artifacts`, in the order of how much a view changes without them: the
    squared change of its image over its squared error, in the view where that is largest. As many are removed, least
    first, as lower the PSNR of no training view by more than `TOLERANCE` times the strength; each number that is tried
    is rendered.

    Args:
        fit: a splat with the cameras and photos that it was fitted to.
        strength: above 0, at most `MAX_STRENGTH`.
        bar: wraps the loops to show their progress, see :mod:`kgs._support.progress`.

    Raises:
        ValueError: the scene was loaded without photos, the strength is out of range, or no Gaussian would be left.
    """
    check_strength(strength)
    views = fit.scene.train
    if views.images.is_meta:
        raise ArgumentError("fit", "a scene with its photos", "one that was loaded without them")
    renders = ViewRenders(views, fit.render_with_depth)
    artifacts = find_artifacts(fit.model, strength, views.cameras, renders.median_depths)
    before = [*renders.psnr_per_view]
    candidates = artifacts.any.nonzero()[:, 0]
    order = candidates[_changes(fit, artifacts.any, before, bar).argsort()]
    cleaned = fit
    after = before
    low = 0
    high = len(order)
    count = high  # all of them, and then by halves
    while high - low >= max(1, len(order) // _PARTS):
        rows = torch.ones_like(artifacts.any)
        rows[order[:count]] = False
        part = replace(fit, model=fit.model.select(rows))
        levels = psnr_per_view(part)
        if all(old - new <= TOLERANCE * strength for old, new in zip(before, levels, strict=True)):
            cleaned = part
            after = levels
            low = count
        else:
            high = count - 1
        count = (low + high + 1) // 2
    check_left(len(cleaned.model))
    removed = torch.zeros_like(artifacts.any)
    removed[order[:low]] = True
    return Cleaned(cleaned, artifacts.counts(removed), len(order) - low, tuple(before), tuple(after))


def check_strength(strength: float) -> None:
    """Raise a ValueError unless this is a strength."""
    if not 0.0 < strength <= MAX_STRENGTH:
        raise ArgumentError("strength", f"a number above 0, at most {MAX_STRENGTH:g}", strength)


def check_left(count: int) -> None:
    """Raise a ValueError unless a Gaussian is left."""
    if not count:
        raise ArgumentError("strength", "one at which a Gaussian is left", "one at which all are artifacts")


def _median(values: Tensor) -> Tensor:
    """The median of some numbers, 0 without any."""
    return values.median() if len(values) else values.new_zeros(())


def _farther(means: Tensor) -> Tensor:
    """Distances from the median of the centres `(N, 3)` over their median, at least 1, `(N,)`."""
    if not len(means):
        return means.new_ones(0)
    distances = (means - means.median(dim=0).values).norm(dim=1)
    relative: Tensor = distances / _median(distances)
    return relative.nan_to_num(nan=1.0).clamp_min(1.0)


def _spacing(means: Tensor) -> Tensor:
    """The root mean squared distance to the three nearest centres, `(N,)`, or 0 of too few or equal centres."""
    if len(means) <= NEIGHBOURS or bool((means == means[0]).all()):
        return means.new_zeros(len(means))
    return log_spacing(means).exp()


def _evidence(means: Tensor, cameras: PinholeCamera, depths: Sequence[Tensor], behind: float) -> tuple[Tensor, Tensor]:
    """How many cameras confirm each Gaussian, and how many see through it, both int64 `(N,)`.

    `behind` is how much farther the median depth is where a camera sees through.
    """
    pixels, own_depths = project(cameras, means)
    confirmed = torch.zeros(len(means), dtype=torch.int64)
    seen_through = torch.zeros_like(confirmed)
    for view, depth in enumerate(depths):
        own = own_depths[:, view]
        x, y, inside = nearest_pixels(pixels[:, view], own, *depth.mT.shape)
        shown = depth.double()[y, x]
        confirmed += inside & ((own - shown).abs() <= CONFIRMED * shown)
        seen_through += inside & (shown > (1.0 + behind) * own)
    return confirmed, seen_through


def _near(means: Tensor, cameras: PinholeCamera, confirmed: Tensor, share: float) -> Tensor:
    """Which are closer to a camera than a share of the 1st percentile of the confirmed depths, bool `(N,)`."""
    near = torch.zeros_like(confirmed)
    if not bool(confirmed.any()):
        return near
    limit = share * typical_depths(means[confirmed], cameras)[0]
    for centre in camera_centers(cameras.extrinsics):
        near |= (means - centre).norm(dim=1) < limit
    return near


def _changes(fit: Fit, rows: Tensor, levels: Sequence[float], bar: ProgressBar) -> Tensor:
    """How much the image of a training view changes without each of the M Gaussians at `rows`, bool `(N,)`.

    The largest over the views of the squared change, summed over the pixels that count, over the mean squared error of
    the view, which its PSNR gives: `levels`. An image is affine in the opacity of one Gaussian, so its change is the
    gradient by a factor of that opacity; sums of the gradients times random signs, squared, are the sums of their
    squares in the mean.
    """
    views = fit.scene.train
    renderer = GaussianRenderer(options=fit.options, backend=fit.backend).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        gaussians = fit.model()
    changes = torch.zeros_like(gaussians.opacities)
    for i in bar(range(len(views)), "artifacts", "view"):
        camera = to(views.camera(i), fit.device)
        squares = torch.zeros_like(changes)
        for _ in range(_SIGNS):
            factors = torch.ones_like(changes).requires_grad_()
            image = renderer(replace(gaussians, opacities=factors * gaussians.opacities), camera).image
            signs = 2.0 * torch.randint(0, 2, image.shape, generator=generator).to(image) - 1.0
            if views.valid_mask is not None:
                signs *= views.valid_mask[i].to(image)
            image.backward(signs)
            if factors.grad is not None:
                squares += factors.grad.square()
        error = 10.0 ** (-0.1 * levels[i])
        changes = torch.maximum(changes, squares / (_SIGNS * error))
    return changes[rows]
