"""Whether "auto" may take the kernels on a card: a small scene has to come out as in torch.

That they have passed is kept on disk, beside what Triton has compiled for the card. A failed check is not kept: the
next process checks again.
"""

import functools
import hashlib
import json
import os
import platform
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
import triton
from triton.runtime.cache import get_cache_manager

from kgs._support.errors import cause_of, warn
from kgs._support.version import __version__

_FILE = "kgs_self_check.json"
_DRIVERS = ("nvidia", "amdgpu", "xe", "i915")  # modules of Linux
_SETTINGS = ("TRITON", "PTXAS", "LLVM", "AMDGCN")  # in names of variables


def is_trusted(device: torch.device) -> bool:
    """Whether the kernels pass :func:`passes_check`, once for each GPU; never in the interpreter."""
    if device.type == "cpu" or os.environ.get("TRITON_INTERPRET") == "1":
        return False
    index = torch.get_device_module(device).current_device() if device.index is None else device.index
    try:
        return passes_check(torch.device(device.type, index))
    except torch.OutOfMemoryError:  # says nothing about the kernels
        return False


@functools.cache
def passes_check(device: torch.device) -> bool:
    """Whether a small scene comes out as in torch on a device; a warning says what is wrong.

    The first time on a machine the kernels are compiled, which takes seconds, and the log says how far that is.

    Raises:
        torch.OutOfMemoryError: there is no room for it now; what is raised is not remembered.
    """
    from kgs.backends.gpu import TRITON
    from kgs.backends.self_check import BOUND, FITS, largest_error

    if is_kept(device):
        return True
    try:  # twice: from their second call on kernels are launched in another way, see `.launch`
        error = max(largest_error(TRITON, device, FITS) for _ in range(2))
    except torch.OutOfMemoryError:
        raise
    except Exception as broken:  # a compiler that does not know the card, a driver: kgs can do without
        reason = cause_of(broken)
    else:
        if error <= BOUND:
            keep(device)
            return True
        reason = f"they differ from torch by {error:.1e}, more than {BOUND:g}"
    warn(f"kgs: Triton's kernels are not used on {device}, torch is: {reason}")
    return False


def is_kept(device: torch.device) -> bool:
    """Whether a check has passed with all that `_subject` names; False where it cannot be read.

    Args:
        device: a GPU.
    """
    with suppress(Exception):  # a cache that is damaged, or cannot be read, or another one than Triton's own
        subject = _subject(device)
        path = _cache(subject).get_file(_FILE)
        return path is not None and bool(json.loads(Path(path).read_text(encoding="utf-8")) == subject)
    return False


def keep(device: torch.device) -> None:
    """Keep that the check has passed; does nothing where it cannot be written."""
    with suppress(Exception):
        subject = _subject(device)
        _cache(subject).put(json.dumps(subject, indent=1), _FILE, binary=False)


def _cache(subject: dict[str, str]) -> Any:
    """The folder of a check, as Triton has one for each kernel."""
    return get_cache_manager(hashlib.sha256(json.dumps(subject).encode()).hexdigest())


def _subject(device: torch.device) -> dict[str, str]:
    """What the outcome depends on."""
    card = torch.get_device_module(device).get_device_properties(device)
    return {
        "card": f"{card.name} {getattr(card, 'gcnArchName', '')}".strip(),
        "driver": _driver(card),
        "torch": torch.__version__,
        "triton": triton.__version__,
        "settings": _settings(),
        "kgs": __version__,
        "source": _source(),
    }


def _settings() -> str:
    """What the environment says to Triton's compiler, as another assembler."""
    return ", ".join(f"{k}={v}" for k, v in sorted(os.environ.items()) if any(word in k for word in _SETTINGS))


def _driver(card: Any) -> str:
    """What is known of the versions of the driver; some are a part of Linux."""
    found = [platform.release(), str(getattr(card, "driver_version", ""))]
    if hasattr(torch._C, "_cuda_getDriverVersion"):
        found.append(str(torch._C._cuda_getDriverVersion()))
    for name in _DRIVERS:
        with suppress(OSError):
            found.append(f"{name} {Path('/sys/module', name, 'version').read_text(encoding='utf-8').strip()}")
    return ", ".join(filter(None, found))


def _source() -> str:
    """A hash of the kernels, and of what calls and checks them."""
    folder = Path(__file__).parent
    files = [*sorted(folder.glob("*.py")), folder.parent / "self_check.py"]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
