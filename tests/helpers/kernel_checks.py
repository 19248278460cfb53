"""What tests of kernels have in common."""

import pytest


def assembly(kernel, *types):
    """What LLVM makes of a kernel for these arguments, compiled afresh: code from the cache has no text."""
    import numba as nb

    options = {key: value for key, value in kernel.targetoptions.items() if key not in ("cache", "nopython")}
    fresh = nb.njit(**options)(kernel.py_func)
    fresh.compile(types)
    return "".join(fresh.inspect_asm().values())


def avx_assembly(kernel, *types):
    """The same, where the processor has AVX; else the test is skipped."""
    text = assembly(kernel, *types)
    if "ymm" not in text:
        pytest.skip("no AVX")
    return text
