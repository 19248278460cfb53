"""Selects the degree of the spherical harmonics before a fit: whether colours depend on the direction, by the photos.

Dense initial points come with the colours of small patches of surface in the views that agree on their depth. Each of
these colours is predicted from those of the other views: once as their mean, once by harmonics of degree 3, whose
coefficients have the same variance before anything is known (ridge regression, or kriging with the kernel of the
harmonics). What wrong depths, noise and hidden surfaces do to colours is no function of the direction and is not
predicted, or little of it; exposure and white balance are removed before, and outliers are bounded.

The fall of the variance of the errors is what harmonics can take off the squared error of a fit. They are chosen where
this would raise a typical fit, `TYPICAL` decibels on test views, by more than `MIN_GAIN`.
"""

import math

import torch
from torch import Tensor

from kgs.datasets.splits import select_evenly
from kgs.init_points import InitialPoints
from kgs.init_points.patches import MIN_PATCHES, PatchColors

from .decisions import DegreeDecision

DEGREE = 3  # of the harmonics that are chosen
MIN_VIEWS = 4  # training views: three do not determine harmonics
MAX_PATCHES = 6000  # that are used, to bound the time
TYPICAL = 25.0  # dB
MIN_GAIN = 0.2  # dB
ROUNDS = 5  # of the exposures
MAX_APART = 4.0  # from a patch's median, in medians of all such differences
FLAT_PRIOR = 1e3  # variance of a patch's colour without its dependence on the direction


def decide_degree(points: InitialPoints) -> DegreeDecision:
    """The degree of the harmonics, and why: 0 without initial points that have patches of at least four views."""
    patches = points.patches
    if patches is None:
        return DegreeDecision(0, "rule", f"no colours to compare with {points.kind} initial points")
    if patches.visible.shape[1] < MIN_VIEWS:
        return DegreeDecision(0, "rule", "too few views")
    if len(patches) < MIN_PATCHES:
        return DegreeDecision(0, "rule", "too little surface that three views agree on")
    gain = possible_gain(patches)
    chosen = DEGREE if gain > MIN_GAIN else 0
    return DegreeDecision(chosen, "photos", over=DEGREE - chosen, gain=round(gain, 3), n=len(patches))


def possible_gain(patches: PatchColors) -> float:
    """By how many dB harmonics can raise a fit of `TYPICAL` dB, below 0 where they predict worse than the mean."""
    rows = select_evenly(len(patches), min(len(patches), MAX_PATCHES))
    visible = patches.visible[rows]
    colors = _without_outliers(without_exposure(patches.colors, patches.visible)[rows], visible)
    directions = patches.directions[rows]
    variances = [
        float(1.4826 * _errors(colors, visible, kernel).abs().median()) ** 2
        for kernel in (torch.zeros(1, 1, 1), harmonics_kernel(directions))
    ]
    explained = (variances[0] - variances[1]) / 10 ** (-TYPICAL / 10)
    return -10 * math.log10(max(1 - explained, 1e-6))


def without_exposure(colors: Tensor, visible: Tensor) -> Tensor:
    """Colours `(P, V, 3)` with each view's gain and offset per channel removed, where `visible` `(P, V)`.

    Robust regression on the patches' means over views: differences larger than the median count less.
    """
    seen = visible[..., None].to(colors.dtype)
    corrected = colors
    for _ in range(ROUNDS):
        means = (seen * corrected).sum(1, keepdim=True) / seen.sum(1, keepdim=True)
        differences = corrected - means
        typical = differences[visible].abs().median().clamp_min(1e-4)
        weights = seen / (1 + (differences / (3 * typical)).square())
        total = weights.sum(0).clamp_min(1e-6)
        own_level = (weights * colors).sum(0) / total
        level = (weights * means).sum(0) / total
        own = colors - own_level
        gains = ((weights * own * (means - level)).sum(0) + 1e-3) / ((weights * own.square()).sum(0) + 1e-3)
        corrected = level + own * gains / gains.mean(0)  # the mean exposure stays
    return corrected


def _without_outliers(colors: Tensor, visible: Tensor) -> Tensor:
    """Colours at most `MAX_APART` typical differences from their patch's median: hidden surfaces have any colour."""
    medians = colors.masked_fill(~visible[..., None], math.nan).nanmedian(1, keepdim=True).values
    differences = colors - medians
    maximum = MAX_APART * float(differences[visible].abs().median())
    return medians + differences.clamp(-maximum, maximum)


def harmonics_kernel(directions: Tensor) -> Tensor:
    """The covariance `(P, V, V)` of harmonics of degree 1 to 3 in unit directions `(P, V, 3)`, with a variance of 1.

    By the addition theorem it is a sum of Legendre polynomials of the cosine, weighted by the 2 l + 1 coefficients of
    each degree l.
    """
    cosines = directions @ directions.mT
    squares = cosines.square()
    second = (3 * squares - 1) / 2
    third = (5 * squares - 3) * cosines / 2
    return (3 * cosines + 5 * second + 7 * third) / 15


def _errors(colors: Tensor, visible: Tensor, kernel: Tensor) -> Tensor:
    """Each visible colour minus its prediction from the patch's colours in the other views, `(N, 3)`.

    The dependence on the direction has the covariance `kernel`, and as much variance as the noise. The errors of all
    left-out views follow from one inverse.
    """
    both = (visible[:, :, None] & visible[:, None]).double()
    covariance = both * (kernel.double() + FLAT_PRIOR) + torch.eye(visible.shape[1], dtype=torch.float64)
    inverse = torch.linalg.inv(covariance)
    errors = (inverse @ (visible[..., None] * colors).double()) / inverse.diagonal(dim1=1, dim2=2)[..., None]
    found: Tensor = errors[visible]
    return found
