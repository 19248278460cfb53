"""Losses of the fit."""

from .opacity import opacity_l1
from .photometric import TargetMoments, photometric_loss, target_moments

__all__ = ["opacity_l1", "photometric_loss", "target_moments", "TargetMoments"]
