"""The web page of a splat: one HTML file with a viewer, photos beside renders, and the measurements of the fit."""

from .pictures import Picture
from .write import write_page

__all__ = ["Picture", "write_page"]
