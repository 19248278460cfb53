"""Triton's kernels in its interpreter, where there is no GPU: `tests/conftest.py` has turned that on."""

import dataclasses
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
def _fast_interpreter():
    """Without what takes most of the interpreter's time; on another version of Triton as slow as it is.

    It scans element by element, here row by row. It searches Triton's language for what to replace in each call of a
    function that a kernel calls, here once in each launch for each module. It looks for integers that overflow, and
    does nothing about them.
    """
    with pytest.MonkeyPatch.context() as patch:
        with suppress(ImportError, AttributeError):
            from triton.runtime import interpreter

            patch.setattr(interpreter.ScanOps, "generic_scan", _scan)
            options = dataclasses.replace(interpreter.interpreter_builder.options, sanitize_overflow=False)
            patch.setattr(interpreter.interpreter_builder, "options", options)
            replace, launch, modules = interpreter._patch_lang, interpreter.GridExecutor.__call__, set()
            nothing = interpreter._LangPatchScope

            def replace_once(function):
                module = id(function.__globals__)
                if module in modules:
                    return nothing()
                modules.add(module)
                return replace(function)

            def first(self, *arguments, **options):
                modules.clear()
                return launch(self, *arguments, **options)

            patch.setattr(interpreter, "_patch_lang", replace_once)
            patch.setattr(interpreter.GridExecutor, "__call__", first)
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
