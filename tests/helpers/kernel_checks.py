"""What tests of kernels have in common."""

import pytest
import torch


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


def check_bits(run, threads):
    """Each of these numbers of threads gives the same tensors, to the bit."""
    before = torch.get_num_threads()
    results = []
    try:
        for count in threads:
            torch.set_num_threads(count)
            results.append(run())
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for some in results for a, b in zip(some, results[0], strict=True))
