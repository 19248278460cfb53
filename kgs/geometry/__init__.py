"""Cameras, Gaussians and the closed forms between them: what the backends and all above them stand on."""
