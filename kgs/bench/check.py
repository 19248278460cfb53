"""What kgs finds on a machine, and whether it works: what to run first, and what belongs into a report of a fault."""

import platform
from importlib.util import find_spec

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
    "scenes": ("cv2", "photos, scenes and initial points"),
    "fast": ("numba", "kernels for CPUs"),
    "app": ("matplotlib", "fits and the other commands"),
    "sfm": ("pycolmap", "photos without cameras"),
    "heic": ("pi_heif", "iPhone's photos"),
    "study": ("pandas", "kgs study"),
}
_NO_TRITON = {"mps": "Apple's GPUs have no Triton, and kgs has not been tried on them: use --device cpu"}


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
            said, works = _examine(backend, each)
            faults += not works
            print(f"  {backend.name:<22}{said}{'   auto takes it' if works and backend.name == taken else ''}")
    print(f"\noff by: from the reference in float64, image and gradients, 300 Gaussians; expected at most {BOUND:g}")
    print(f"10 000, 50 000: Gaussians; a training step at {SIZE[1]}x{SIZE[0]} without densification")
    missing = {extra: of for extra, of in _EXTRAS.items() if find_spec(of[0]) is None}
    for extra, (_, use) in missing.items():
        print(f"not installed: {use} ({installing(extra)})")
    return 1 if faults else 0


def _devices() -> list[torch.device]:
    """The CPU, and all GPUs that torch can use."""
    gpus = [("cuda", torch.cuda), ("xpu", torch.xpu)]
    counts = {kind: of.device_count() for kind, of in gpus if of.is_available()}
    return [torch.device("cpu"), *(torch.device(kind, i) for kind, count in counts.items() for i in range(count))]


def _describe(device: torch.device) -> str:
    """The name of a device, and what its driver says of it."""
    if device.type == "cpu":
        return f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    if device.type == "cuda":
        own = torch.cuda.get_device_properties(device)
        kind = f"ROCm {torch.version.hip}" if torch.version.hip else f"CUDA {torch.version.cuda}"
        return f"{own.name}, {own.total_memory / 2**30:.0f} GiB, {own.major}.{own.minor}, {kind}"
    return device.type


def _examine(backend: Backend, device: torch.device) -> tuple[str, bool]:
    """Error and times of a backend in a line, or why there are none; and whether it works where it should."""
    if backend.runs_on(device) and not backend.is_installed():
        package, how = backend.package or ("", "")
        return f"not installed: {package}; {how}", True
    if not backend.runs_on(device) or (device.type, backend.name) == ("cpu", "triton"):
        return f"not for {device.type}", True
    try:
        off = _off_by(backend, device)
        cases = (Cases(count, SIZE, device, backend.name) for count in COUNTS)
        seconds = [take_turns({"step": case.train}, 3, device)["step"].wall for case in cases]
    except Exception as error:  # whatever a compiler, a driver or a broken package does
        return f"WRONG: {cause_of(error)}", False
    if not off <= BOUND:  # NaN
        return f"WRONG: expected at most {BOUND:g} (off by {off:.1e})", False
    return f"{off:>9.1e}" + "".join(f"{1e3 * value:>8.1f} ms" for value in seconds), True


def _off_by(backend: Backend, device: torch.device) -> float:
    """The largest error of image and gradients against the dense reference, and of each stage against torch's."""
    model, camera = layered_scene(300, (48, 64))
    scene = (model(), camera)
    image, slopes = exact(scene, RasterOptions.near_plane)
    gaussians, camera = cast(scene, torch.float32)
    renderer = GaussianRenderer(backend=backend.name, alpha_threshold=0.0, transmittance_stop=0.0)
    drawn = renderer(gaussians.to(device), to(camera, device)).image.cpu()
    of_image = (drawn - image).detach().abs().max()
    of_gradients = relative_errors(gradients(drawn, gaussians), slopes).max()
    of_stages = 0.0 if backend.name == "torch" else largest_error(backend, device)
    return float(torch.tensor([of_image, of_gradients, of_stages]).max())  # NaN stays
