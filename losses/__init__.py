"""Losses of the fit."""

from .photometric import TargetMoments, photometric_loss, target_moments

__all__ = ["photometric_loss", "target_moments", "TargetMoments"]
