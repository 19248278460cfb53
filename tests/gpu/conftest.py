"""Triton's kernels in its interpreter, where there is no GPU: `tests/conftest.py` has turned that on."""

import os
from contextlib import suppress

import numpy as np
import pytest

pytest.importorskip("triton")


@pytest.fixture(autouse=True)
def _interpreted() -> None:
    """These tests call kernels on a CPU; on a machine with a GPU `-m cuda` has the same in `tests/device`."""
    if os.environ.get("TRITON_INTERPRET") != "1":
        pytest.skip("Triton's interpreter is off")


@pytest.fixture(scope="session", autouse=True)
def _scans_by_rows():
    """The interpreter scans element by element, which takes most of the time: here it scans row by row."""
    with pytest.MonkeyPatch.context() as patch:
        with suppress(ImportError, AttributeError):  # of another version: slow
            from triton.runtime.interpreter import ScanOps

            patch.setattr(ScanOps, "generic_scan", _scan)
        yield


def _scan(self, values):
    """What `ScanOps.generic_scan` returns."""
    rows = [np.moveaxis(x.handle.data, self.axis, 0) for x in values]
    found = [np.empty_like(x) for x in rows]
    for i in range(len(rows[0])):
        row = tuple(self.to_tensor(np.ascontiguousarray(x[i]), v.dtype) for x, v in zip(rows, values, strict=True))
        if i:
            before = (self.to_tensor(x[i - 1], v.dtype) for x, v in zip(found, values, strict=True))
            row = self.combine_fn.fn(*before, *row)
        for out, value in zip(found, row, strict=True):
            out[i] = value.handle.data
    return [self.to_tensor(np.moveaxis(x, 0, self.axis), v.dtype) for x, v in zip(found, values, strict=True)]
