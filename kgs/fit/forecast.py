"""What a fit takes in time and memory, told before it begins."""

from torch import Tensor

from kgs.backends import resolve
from kgs.machine import bytes_of, check_device

from .config import FitConfig, most_gaussians

_STEP, _PIXEL = 0.025, 1.5e-7  # seconds of a step with 20 000 to 30 000 Gaussians, on two cores of an AMD EPYC
_TORCH = 4.0  # times as long as the compiled backend


def forecast(photos: Tensor, points: int, config: FitConfig) -> str:
    """Time and memory of a fit in words, as `expected_seconds` and `most_bytes` have them."""
    memory = f"at most {most_bytes(photos, points, config) / 2**20:.0f} MiB of memory"
    gaussians = f"with {most_gaussians(config, points)} Gaussians"
    seconds = expected_seconds(photos, config)
    if seconds is None:
        return f"the fit takes {memory} {gaussians}"
    return f"the fit takes about {seconds:.0f} s, within a factor of two, and {memory} {gaussians}"


def expected_seconds(photos: Tensor, config: FitConfig) -> float | None:
    """What the steps of a fit take on a CPU, within a factor of two; None on other devices.

    Args:
        photos: the training images `(V, 3, H, W)`.
        config: steps, device and backend of the fit.
    """
    device = check_device(config.device)
    if device.type != "cpu":
        return None
    slower = _TORCH if resolve(config.backend, device) == "torch" else 1.0
    return slower * config.steps * (_STEP + _PIXEL * photos[0, 0].numel())


def most_bytes(photos: Tensor, points: int, config: FitConfig) -> int:
    """A bound for the bytes that a fit takes beyond what the process has before it.

    Args:
        photos: the training images `(V, 3, H, W)`.
        points: the number of initial points.
        config: of the fit.
    """
    return config.max_bytes + bytes_of(most_gaussians(config, points), photos)
