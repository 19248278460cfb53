"""The weight files of LPIPS, which the user provides. Loads neither NumPy nor torch, as the command wants it."""

import zipfile
from os import PathLike
from pathlib import Path

from kgs.errors import DataError


def weight_files(folder: str | PathLike[str], net: str = "vgg16") -> tuple[Path, Path]:
    """The npz files of a network and of its heads; a DataError where the folder or one of them is not there."""
    folder, names = Path(folder), (f"{net}_features.npz", f"lpips_lin_{net}.npz")
    if not folder.is_dir():
        raise DataError(folder, "", f"expected a folder with {names[0]} and {names[1]}, got none")
    for path in (folder / name for name in names):
        if not zipfile.is_zipfile(path):
            got = "another format or a part of one" if path.is_file() else "none"
            raise DataError(path, "", f"expected an npz file of LPIPS weights, got {got}")
    return folder / names[0], folder / names[1]
