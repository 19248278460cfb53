"""The machine that a fit runs on: devices, versions of packages, memory."""

import contextlib
import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import kornia
import torch

from kgs._support.errors import ArgumentError, quantity

from .version import __version__


def check_device(name: str) -> torch.device:
    """The device of that name; ValueError if torch has no such device, or its tensors hold no numbers."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()  # the meta device has no numbers
    except Exception as error:  # RuntimeError, AssertionError or ImportError, by the backend
        reason = str(error).partition(". ")[0].splitlines()[0]
        raise ArgumentError("device", "cpu or a GPU of this machine", f"{name!r} ({reason:.120})") from error
    return device


def device_name(device: torch.device) -> str:
    """What a user knows a device as: "CPU, 2 cores", of which torch uses so many, or the name of a GPU."""
    if device.type == "cpu":
        return f"CPU, {quantity(torch.get_num_threads(), 'core')}"
    return f"{torch.get_device_module(device).get_device_name(device)} ({device})"


def versions() -> dict[str, str]:
    """Versions of everything that affects a result; without OpenCV, numba or triton if they are not installed."""
    result = {"kgs": __version__, "torch": torch.__version__, "kornia": kornia.__version__}
    with contextlib.suppress(ModuleNotFoundError):
        import cv2

        result["opencv"] = cv2.__version__
    for package in ("numba", "triton"):
        with contextlib.suppress(PackageNotFoundError):
            result[package] = version(package)
    return result | {"python": platform.python_version(), "machine": f"{platform.machine()}, {os.cpu_count()} cores"}


def revision(path: Path) -> str | None:
    """The commit that last changed a file or folder, as "1a2b3c4 of 2026-11-22"; None where git does not know it."""
    try:
        commit = _git(path, "log", "-1", "--format=%h of %cs")
        changes = _git(path, "status", "--porcelain")
    except (OSError, subprocess.CalledProcessError):
        return None
    if not commit:
        return None
    return f"{commit} and later changes" if changes else commit


def _git(path: Path, *arguments: str) -> str:
    """What a git command prints about a file or folder."""
    call = ["git", "-C", str(path.parent), *arguments, "--", path.name]
    return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()


def peak_rss_mb() -> int:
    """Largest resident memory of this process so far, in MiB; 0 where the system does not report it (Windows)."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    for line in lines:  # on Linux, getrusage may return the peak of the parent process
        if line.startswith("VmHWM"):
            return round(int(line.split()[1]) / 2**10)
    try:
        import resource
    except ModuleNotFoundError:
        return 0
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)
