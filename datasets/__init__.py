"""Scenes on disk as posed images."""
