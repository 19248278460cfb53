"""Which extra of kgs brings a package, and whether there are several of OpenCV's."""

from contextlib import suppress

EXTRAS = {
    "PIL": "scenes",
    "cv2": "scenes",
    "trimesh": "scenes",
    "numba": "fast",
    "pi_heif": "heic",
    "pycolmap": "sfm",
    "distributed": "study",
    "pandas": "study",
    "scipy": "study",
}  # all others are of `app`


def missing(package: str) -> str:
    """What to do about a package that is not installed."""
    extra = EXTRAS.get(package.partition(".")[0], "app")
    return f"{package} is missing: run {installing(extra)}"


def installing(extra: str) -> str:
    """The commands that install an extra."""
    return f'pip install ".[{extra}]" in a clone of kgs, or pip install "kgs-splat[{extra}]" where an index has it'


def check_opencv() -> None:
    """Warn where several packages of OpenCV are installed: their files overwrite each other."""
    from importlib.metadata import PackageNotFoundError, version

    from .errors import warn

    found = []
    for kind in ("", "-headless"):
        for package in (f"opencv-python{kind}", f"opencv-contrib-python{kind}"):
            with suppress(PackageNotFoundError):
                found.append(f"{package} {version(package)}")
    if len(found) > 1:
        warn(
            f"kgs: expected one package that brings cv2, got {' and '.join(found)}: whichever was installed last has "
            "overwritten files of the others; uninstall all of them, then install one"
        )
