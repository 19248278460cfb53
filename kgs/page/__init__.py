"""A page of a splat: one HTML file with a viewer, photos beside renders, and what is known of the fit."""

from .pictures import Picture
from .write import MOST_BYTES, write_page

__all__ = ["MOST_BYTES", "Picture", "write_page"]
