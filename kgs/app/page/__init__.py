"""The web page of a splat: one HTML file with a viewer, photos beside renders, and the measurements of the fit."""

from .content import PageContent, PagePhotos, PageSplat, PageText
from .pictures import Picture
from .write import write_page

__all__ = ["PageContent", "PagePhotos", "PageSplat", "PageText", "Picture", "write_page"]
