"""Files: splats, cameras, images, checkpoints and the folder of results; and what the console shows."""
