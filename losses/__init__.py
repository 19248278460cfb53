"""Losses of the fit."""
