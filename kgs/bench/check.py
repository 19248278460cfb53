"""What kgs finds on a machine, and whether it works: what to run first, and what belongs into a report of a fault."""

import platform
from importlib.util import find_spec
from typing import NamedTuple

import torch

from kgs._support.errors import cause_of
from kgs._support.extras import installing
from kgs._support.machine import check_device, versions
from kgs.backends import BACKENDS, Backend, get_backend
from kgs.backends.self_check import BOUND, largest_error
from kgs.geometry.cameras import to
from kgs.geometry.types import RasterOptions
from kgs.renderer import GaussianRenderer

from .scenes import cast, exact, gradients, layered_scene, relative_errors
from .speed import SIZE, Cases
from .timing import take_turns

COUNTS = (10_000, 50_000)  # Gaussians whose training steps are timed
# of each extra a package that only it brings, and what it is for
_EXTRAS = {
    "scenes": ("cv2", "photos, scenes and fits"),
    "fast": ("numba", "kernels for CPUs"),
    "app": ("matplotlib", "the other commands"),
    "sfm": ("pycolmap", "photos without cameras"),
    "heic": ("pi_heif", "iPhone's photos"),
    "study": ("pandas", "kgs study"),
}
_NO_TRITON = {"mps": "Apple's GPUs have no Triton, and kgs has not been tried on them: use --device cpu"}


class _Result(NamedTuple):
    """How a backend does on a device: error, milliseconds by count, and what is wrong, "" if nothing is."""

    error: float
    milliseconds: list[float]
    wrong: str


def check(*, device: str | None = None) -> int:
    """Print versions, devices and backends: how far each is from the reference, and how fast; 1 if anything is wrong.

    Args:
        device: one to check; None checks the CPU and all GPUs of CUDA, ROCm or XPU.

    Raises:
        ValueError: torch has no such device.
    """
    if device in _NO_TRITON:
        print(f"kgs: {_NO_TRITON[device]}")
        return 0
    devices = _devices() if device is None else [check_device(device)]
    *packages, (_, machine) = versions().items()
    print(", ".join(f"{name} {version}" for name, version in packages))
    print(f"{platform.platform()}, {machine}\n")
    print(f"{'':24}{'off by':>9}{'10 000':>11}{'50 000':>11}")
    faults = 0
    for each in devices:
        print(f"{each}: {_describe(each)}")
        taken = get_backend("auto", each).name
        for backend in BACKENDS.values():
            result = _examine(backend, each) if _is_there(backend, each) else _Result(0.0, [], "")
            faults += bool(result.wrong)
            print(f"  {backend.name:<22}{_row(backend, each, result, backend.name == taken)}")
    print(f"\noff by: from the reference in float64, image and gradients, 300 Gaussians; expected at most {BOUND:g}")
    print(f"10 000, 50 000: Gaussians; a training step at {SIZE[1]}x{SIZE[0]} without densification")
    missing = {extra: of for extra, of in _EXTRAS.items() if find_spec(of[0]) is None}
    for extra, (_, use) in missing.items():
        print(f"not installed: {use} ({installing(extra)})")
    return 1 if faults else 0


def _devices() -> list[torch.device]:
    """The CPU, and all GPUs that torch can use."""
    devices = [torch.device("cpu")]
    if torch.cuda.is_available():
        devices += [torch.device("cuda", i) for i in range(torch.cuda.device_count())]
    if torch.xpu.is_available():
        devices += [torch.device("xpu", i) for i in range(torch.xpu.device_count())]
    return devices


def _describe(device: torch.device) -> str:
    """The name of a device, and what its driver says of it."""
    if device.type == "cpu":
        return f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    if device.type == "cuda":
        own = torch.cuda.get_device_properties(device)
        kind = f"ROCm {torch.version.hip}" if torch.version.hip else f"CUDA {torch.version.cuda}"
        return f"{own.name}, {own.total_memory / 2**30:.0f} GiB, {own.major}.{own.minor}, {kind}"
    return device.type


def _is_there(backend: Backend, device: torch.device) -> bool:
    return backend.runs_on(device) and backend.is_installed() and (device.type, backend.name) != ("cpu", "triton")


def _examine(backend: Backend, device: torch.device) -> _Result:
    """Agreement and times; what is wrong in one line."""
    try:
        off = _off_by(backend.name, device)
        if backend.name != "torch":
            off = max(off, largest_error(backend, device))
        milliseconds = [1e3 * _seconds(count, backend.name, device) for count in COUNTS]
    except Exception as error:  # whatever a compiler, a driver or a broken package does
        return _Result(float("nan"), [], cause_of(error))
    wrong = "" if off <= BOUND else f"expected at most {BOUND:g}"
    return _Result(off, milliseconds, wrong)


def _off_by(backend: str, device: torch.device) -> float:
    """The largest error of image and gradients against the dense reference."""
    model, camera = layered_scene(300, (48, 64))
    scene = (model(), camera)
    image, slopes = exact(scene, RasterOptions.near_plane)
    gaussians, camera = cast(scene, torch.float32)
    renderer = GaussianRenderer(backend=backend, alpha_threshold=0.0, transmittance_stop=0.0)
    drawn = renderer(gaussians.to(device), to(camera, device)).image.cpu()
    errors = relative_errors(gradients(drawn, gaussians), slopes)
    return max(float((drawn - image).detach().abs().max()), float(errors.max()))


def _seconds(count: int, backend: str, device: torch.device) -> float:
    """A training step."""
    cases = Cases(count, SIZE, device, backend)
    return take_turns({"step": cases.train}, 3, device)["step"].wall


def _row(backend: Backend, device: torch.device, result: _Result, taken: bool) -> str:
    """The line of a backend, without its name."""
    if result.wrong:
        return f"WRONG: {result.wrong}" + (f" (off by {result.error:.1e})" if result.milliseconds else "")
    if not result.milliseconds:
        package, how = backend.package or ("", "")
        if backend.runs_on(device) and not backend.is_installed():
            return f"not installed: {package}; {how}"
        return f"not for {device.type}"
    times = "".join(f"{value:>8.1f} ms" for value in result.milliseconds)
    return f"{result.error:>9.1e}{times}{'   auto takes it' if taken else ''}"
