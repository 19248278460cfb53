"""The file layouts that `load_scene` reads, one file each: from a folder to a `FrameSet`."""
