"""The file layouts that `load_scene` reads, one file each."""
