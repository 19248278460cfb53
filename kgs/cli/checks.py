"""What can be told of a command's options without torch, which takes seconds, and without a photo's pixels.

`kgs.cli.run` calls the check of a command, with all of its arguments, before anything heavy is loaded. What needs more
the command itself checks.
"""

import ctypes
import sys
from collections.abc import Callable
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from kgs.datasets import folders
from kgs.datasets.options import check_options
from kgs.errors import DataError
from kgs.fit.config import FitConfig
from kgs.io.outputs import EXPORTS, check_folder
from kgs.io.ownership import is_own
from kgs.io.results_folder import replaced_files
from kgs.io.staging import Staging
from kgs.json_files import read_json
from kgs.metrics.weights import weight_files

from .unposed import is_unposed

SMALLEST = 32  # pixels of the longer side of a fit's photos
_ALWAYS = ("torch", "kornia", "numpy", "cv2", "PIL")
# Kinds of devices of torch; a plugin (entry point "torch.backends") may bring others.
_DEVICES = ("cpu", "cuda", "mps", "xpu", "hpu", "mtia", "xla", "ipu", "hip", "ve", "maia", "lazy", "vulkan", "meta")


def check_fit(
    scene: Path,
    out: Path,
    views: int | None,
    hold_out: int | None,
    size: int | None,
    downscale: float | None,
    roll: float,
    lpips_weights: Path | None,
    config: FitConfig,
    **_: Any,
) -> None:
    """Those of `kgs fit`."""
    _check_roll(roll)
    if size is not None and downscale is not None:
        raise ValueError("size: expected either a size or a downscale factor, got both")
    if size is not None and size < SMALLEST:
        raise ValueError(f"size: expected at least {SMALLEST} pixels, got {size}")
    if views is not None and views < 1:
        raise ValueError(f"views: expected a whole number of at least 1, got {views}")
    check_options(downscale, hold_out)
    unposed = is_unposed(scene)
    of_photos = ["pycolmap"] if unposed else []
    _check_tools(config.device, config.backend, "matplotlib", "safetensors", "jinja2", *of_photos)
    if lpips_weights is not None:
        weight_files(lpips_weights)
    check_folder(out, replaced_files(out), scene, make=False)
    if unposed:
        _check_photos(scene, out, views, hold_out, downscale)
    else:
        _check_scene(scene)


def check_demo(out: Path, size: tuple[int, int], steps: int, device: str, backend: str, **_: Any) -> None:
    """Those of `kgs demo`."""
    FitConfig(steps=steps)
    if min(size) < 12:  # the window of SSIM
        raise ValueError(f"size: expected at least 12 pixels a side, got {size[0]} {size[1]}")
    _check_tools(device, backend, "matplotlib", "jinja2")
    check_folder(out, ["index.html", "demo.png", "curve.png", "metrics.json", "splat.ply", *EXPORTS], make=False)


def check_render(cameras: Path, out: Path, downscale: float | None, device: str, backend: str, **_: Any) -> None:
    """Those of `kgs render`."""
    check_options(downscale, None)
    _check_tools(device, backend)
    check_folder(out, (), cameras, make=False)
    _check_layout(cameras)


def check_evaluate(out: Path, lpips_weights: Path | None, device: str, backend: str, **_: Any) -> None:
    """Those of `kgs eval`."""
    _check_tools(device, backend, "jinja2")
    if lpips_weights is not None:
        weight_files(lpips_weights)
    if not Staging(out).finished.exists():
        read_json(out / "config.json")


def check_page(
    cameras: Path, out: Path, downscale: float | None, roll: float, device: str, backend: str, **_: Any
) -> None:
    """Those of `kgs page`."""
    _check_roll(roll)
    check_options(downscale, None)
    _check_tools(device, backend, "jinja2")
    if out.suffix != ".html":
        raise ValueError(f"out: expected a file that ends in .html, got {str(out)!r}")
    if out.exists() and not is_own(out):
        raise DataError(out, "", "was not written by kgs and would be overwritten: choose another file")
    if not out.absolute().parent.is_dir():
        raise DataError(out, "", "expected a file in a folder that is there")
    _check_scene(cameras)


def check_speed(device: str, **_: Any) -> None:
    """Those of `kgs bench speed`."""
    _check_tools(device, "auto", "matplotlib")


def check_study(lpips_weights: Path | None, **_: Any) -> None:
    """Those of `kgs study`."""
    _check_tools("cpu", "auto", "pandas", "scipy", "distributed", "matplotlib", "jinja2")
    if lpips_weights is not None:
        weight_files(lpips_weights)


CHECKS: dict[str, Callable[..., None]] = {
    "demo": check_demo,
    "fit": check_fit,
    "render": check_render,
    "eval": check_evaluate,
    "page": check_page,
    "bench speed": check_speed,
    "study": check_study,
}


def _check_roll(roll: float) -> None:
    """A ValueError unless this is an angle by which pictures can be turned."""
    if not -360 <= roll <= 360:
        raise ValueError(f"roll: expected degrees in [-360, 360], got {roll}")


def _check_tools(device: str, backend: str, *packages: str) -> None:
    """A ModuleNotFoundError where a package is not installed, a ValueError where a device cannot be used."""
    for package in (*_ALWAYS, *packages, *(["numba"] if backend == "numba" else [])):
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"{package} is not installed", name=package)
    if reason := _why_no_device(device.partition(":")[0]):
        raise ValueError(f"device: expected cpu or a GPU of this machine, got {device!r} ({reason})")


def _why_no_device(kind: str) -> str:
    """Why torch cannot use a device of this kind, as far as that is sure before it is loaded; "" where it may."""
    if kind not in _DEVICES and not entry_points(group="torch.backends"):
        return "torch knows cpu, cuda, mps, xpu and others"
    if kind != "cuda":
        return ""
    spec = find_spec("torch")
    build = Path(spec.origin).with_name("version.py") if spec and spec.origin else None
    lines = build.read_text(encoding="utf-8").splitlines() if build and build.is_file() else []
    made_for = {line.partition(":")[0].partition(" ")[0]: line.rpartition("= ")[2].strip() for line in lines}
    if made_for.get("cuda") == "None" and made_for.get("hip", "None") == "None":
        return "torch is installed without CUDA"
    if sys.platform == "linux" and made_for.get("hip", "None") == "None":
        try:
            ctypes.CDLL("libcuda.so.1")
        except OSError:
            return "there is no driver of NVIDIA"
    return ""


def _check_layout(scene: Path) -> None:
    """Raise a DataError unless this is a scene."""
    if folders.layout_of(scene) is None:
        raise DataError(scene, "", folders.why_no_scene(scene))


def _check_scene(scene: Path) -> None:
    """Raise a DataError unless this is a scene with at least one photo."""
    _check_layout(scene)
    if not folders.has_photos(scene):
        raise DataError(scene, "", "has camera poses but no photos: expected them in images/, or where its files say")


def _check_photos(folder: Path, out: Path, views: int | None, hold_out: int | None, downscale: float | None) -> None:
    """Check a folder of unposed photos and what is asked of it; reads their headers only where `downscale` is given."""
    from kgs.sfm.find import find_photos
    from kgs.sfm.place import check_place

    paths = find_photos(folder)
    check_place(out, folder)
    most = len(paths) - (1 if hold_out else 0)
    if views is not None and views > most:
        raise ValueError(f"views: expected at most {most} of {len(paths)} photos, got {views}")
    if downscale is not None:
        from kgs.datasets.image_file import read_size

        width, height = min(read_size(path) for path in paths)
        if max(width, height) / downscale < SMALLEST:
            shrunk = f"{max(1, round(width / downscale))}x{max(1, round(height / downscale))} of {width}x{height}"
            raise ValueError(f"downscale: expected {SMALLEST} pixels or more of the longer side, got {shrunk}")
