"""What has to be installed for a command: it is loaded here, and an error says what brings a missing package."""

import sys
import traceback
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING

from kgs._support.errors import printable
from kgs._support.extras import EXTRAS, missing
from kgs.app.console import say

from .interrupts import interrupt_as_usual

if TYPE_CHECKING:
    import torch

_ALWAYS = ("torch", "kornia", "numpy", "cv2", "PIL")


def check_installed(*packages: str) -> None:
    """Raise a ModuleNotFoundError if a package is not installed. Loads none."""
    for package in packages:
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"{package} is not installed", name=package)


def load_tools(device: str = "cpu", backend: str = "auto", *packages: str) -> "torch.device":
    """Load torch and the packages that a command needs, and return the device.

    It takes seconds: a command calls it after all checks that need no torch. Ctrl-C ends the process at once until
    torch is loaded, and raises KeyboardInterrupt from then on.

    Args:
        device: its name, or "auto", see :func:`_best_device`.
        backend: that has to run on it.
        packages: to load beside those of every command.

    Raises:
        ModuleNotFoundError: a package is not installed; nothing was loaded.
        ImportError: a package is installed, but cannot be loaded.
        ValueError: the device cannot be used, or the backend does not run on it.
    """
    check_installed(*_ALWAYS, *packages, *(["numba"] if backend == "numba" else []))
    for package in ("torch", "kornia", "cv2"):
        load_package(package)
    with suppress(ImportError):  # torch does in its place
        load_package("numba")
    interrupt_as_usual()
    for package in packages:
        load_package(package)
    from kgs._support.machine import check_device
    from kgs.backends import get_backend

    if device == "auto":
        return _best_device(backend)
    found = check_device(device)
    get_backend(backend, found)
    return found


def _best_device(backend: str) -> "torch.device":
    """A GPU on which the backend runs, or "auto" takes kernels; else the CPU.

    A GPU without kernels, or whose kernels fail their check, is taken where the CPU has none either.
    """
    import torch

    from kgs._support.machine import check_device
    from kgs.backends import get_backend

    cpu = torch.device("cpu")
    gpu = next((kind for kind in ("cuda", "xpu") if torch.get_device_module(kind).is_available()), None)
    if gpu is not None and backend != "numba":
        try:
            found = check_device(gpu)
            if get_backend(backend, found).name != "torch" or get_backend(backend, cpu).name == "torch":
                return found
            why = f"--device {gpu} takes the GPU, with torch's operators in place of kernels"
        except ValueError as error:
            why = printable(error)
        say(f"kgs: the CPU is used: {why}", sys.stderr)
    get_backend(backend, cpu)
    return cpu


def load_package(package: str) -> None:
    """Import a package; an ImportError if it fails."""
    try:
        import_module(package)
    except OSError as error:  # torch loads its libraries itself
        raise ImportError(str(error), name=package) from error


def explain_import_error(error: ImportError) -> str:
    """What to do about a package that is missing or broken; "" where that is a mistake in kgs."""
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").partition(".")[0]
    else:
        names = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
        tops = [name.partition(".")[0] for name in [error.name or "", *names]]
        package = next((top for top in tops if top not in ("", "kgs", *sys.stdlib_module_names)), "kgs")
    if package == "kgs":
        return ""
    if package == "triton":  # torch brings it
        return str(error)
    if isinstance(error, ModuleNotFoundError):
        return missing(error.name or package)
    from importlib.metadata import packages_distributions

    project = packages_distributions().get(package, [package])[0]
    reason = printable(str(error).strip().partition("\n")[0].rstrip("."))
    return (
        f"{package} is installed, but cannot be loaded ({reason}): run pip install --force-reinstall {project} "
        f"(of the extra {EXTRAS.get(package, 'app')})"
    )
