"""Functions of Kornia's pinhole cameras, and cameras of other lenses: the public names of `kgs.geometry.cameras`."""

from .geometry.cameras import PosedCamera, joined, pinhole_cameras, posed, project, resized, select, to, turned

__all__ = ["PosedCamera", "joined", "pinhole_cameras", "posed", "project", "resized", "select", "to", "turned"]
