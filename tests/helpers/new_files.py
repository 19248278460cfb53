"""Files that tests damage in many ways, one after the other."""

from pathlib import Path


def write_anew(path: Path, data: bytes) -> None:
    """Write a file that is new: where an old one is cut to nothing, ext4 waits for the disk."""
    path.unlink(missing_ok=True)
    path.write_bytes(data)
