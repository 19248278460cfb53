"""The weight files of LPIPS, which the user provides. Loads neither NumPy nor torch, as the command wants it."""

import zipfile
from os import PathLike
from pathlib import Path

from kgs._support.errors import DataError


def weight_files(folder: str | PathLike[str]) -> tuple[Path, Path]:
    """The npz files of VGG16 and of the heads; a DataError where the folder or one of them is not there."""
    folder = Path(folder)
    features = folder / "vgg16_features.npz"
    heads = folder / "lpips_lin_vgg16.npz"
    if not folder.is_dir():
        raise DataError(folder, "", f"a folder with {features.name} and {heads.name}", "none")
    for path in (features, heads):
        if not zipfile.is_zipfile(path):
            got = "another format or a part of one" if path.is_file() else "none"
            raise DataError(path, "", "an npz file of LPIPS weights", got)
    return features, heads
