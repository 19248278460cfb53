"""What all kernels share: how they are compiled, constants, scratch memory, 2^x."""

import functools
import sys
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba as nb
import numpy as np
from numba.core import event

from .lanes import floor, power_of_two

f32 = np.float32
ZERO, HALF, ONE, TWO = f32(0.0), f32(0.5), f32(1.0), f32(2.0)
LARGEST = np.finfo(np.float32).max

_FAST = {"reassoc", "contract", "nsz", "arcp"}  # without nnan and ninf: see `is_finite`


@functools.cache
def _hash_of_kernels(folder: Path) -> str:
    """A hash of this file and of all kernels of a folder, which contain each other's code."""
    files = [Path(__file__), *sorted(folder.glob("*_kernels.py"))]
    return sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def _cached(**options: Any) -> Callable[[Any], Any]:
    """Numba's decorator. Compiled code stays on the disk until this file or a kernel beside it changes."""

    def decorate(function: Any) -> Any:
        kernel = nb.njit(nogil=True, cache=True, error_model="numpy", **options)(function)
        with suppress(AttributeError):  # without compiling (NUMBA_DISABLE_JIT) there is no cache
            file = kernel._cache._cache_file
            sources = _hash_of_kernels(Path(function.__code__.co_filename).parent)
            file._source_stamp = file._source_stamp, sources
        return kernel

    return decorate


jit, exact = _cached(fastmath=_FAST), _cached()  # `exact` rounds as written
inline: Any = nb.njit(inline="always", fastmath=_FAST, error_model="numpy")

# exp2 on [-1/2, 1/2] as in Cephes' exp2f: relative error 1.2e-7 with its roundings
_E1, _E2, _E3 = f32(6.931472028550421e-1), f32(2.402264791363012e-1), f32(5.550332471162809e-2)
_E4, _E5, _E6 = f32(9.618437357674640e-3), f32(1.339887440266574e-3), f32(1.535336188319500e-4)


@inline
def exp2(x):
    """2^x of lanes, for -126 <= x <= 128: a polynomial times a power of two."""
    n = floor(x + HALF)
    f = x - n
    y = (((((f * _E6 + _E5) * f + _E4) * f + _E3) * f + _E2) * f + _E1) * f + ONE
    return y * power_of_two(n)


@inline
def is_finite(x):
    """Of a float32; numba's `isfinite` looks at x - x, which `reassoc` makes 0 where x is a sum."""
    return abs(x) <= LARGEST


@inline
def scratch(size):
    """Float32 memory that begins at a cache line: numba's own arrays begin at 32 bytes, and AVX-512 wants 64."""
    memory = np.empty(size + 16, np.float32)
    skip = (64 - memory.ctypes.data % 64) % 64 // 4
    return memory[skip : skip + size]


class _Notice(event.Listener):
    """Says on a terminal that the first use takes longer; later ones load what was compiled."""

    said = False

    def on_start(self, event: Any) -> None:
        """Called before numba compiles any function, of kgs or not."""
        module = event.data["dispatcher"].py_func.__module__ or ""  # None for what `exec` made
        ours = module.startswith("kgs.")
        if ours and not self.said and sys.stderr is not None and sys.stderr.isatty():  # None: closed by `2>&-`
            print("kgs: compiling, once, about 20 s", file=sys.stderr, flush=True)
            self.said = True

    def on_end(self, event: Any) -> None:
        """Called after it; does nothing."""


event.register("numba:compile", _Notice())
