"""Splats for other programs: glTF, the list of cameras that viewers read, a film."""
