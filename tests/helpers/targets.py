"""What tests of kernels run on: numba, Triton in its interpreter, and Triton on a card."""

from __future__ import annotations

import dataclasses
import os
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.backends import BACKENDS

CPU = torch.device("cpu")


@dataclasses.dataclass(frozen=True)
class Target:
    """A backend on a device."""

    backend: str
    device: torch.device = CPU

    @property
    def interpreted(self) -> bool:
        """Whether these are kernels in Triton's interpreter, which takes about a second for 100 Gaussians."""
        return self.backend == "triton" and self.device == CPU

    def few(self, count: int, interpreted: int) -> int:
        """The count, or a smaller one where kernels are interpreted."""
        return interpreted if self.interpreted else count

    def move(self, value: Any, dtype: torch.dtype | None = None) -> Any:
        """The same on the device, without a graph; floating-point numbers in the dtype."""
        return move(value, self.device, dtype)


TORCH = Target("torch")
CARD = (pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"))
_NUMBA = pytest.param(Target("numba"), id="numba")
_CARD = pytest.param(Target("triton", torch.device("cuda")), id="triton on a card", marks=CARD)
ALL_KERNELS = [_NUMBA, pytest.param(Target("triton"), id="triton interpreted"), _CARD]
_SELDOM = [_NUMBA, pytest.param(Target("triton"), id="triton interpreted", marks=pytest.mark.slow), _CARD]
SELDOM_INTERPRETED = pytest.mark.parametrize("kernels", _SELDOM, indirect=True)
TRITON = pytest.mark.parametrize("kernels", ALL_KERNELS[1:], indirect=True)


def on_kernels(cases: dict[str, Any], seldom_interpreted: dict[str, Any]) -> pytest.MarkDecorator:
    """Run a test with the fixtures `kernels` and `case` for each case on each of them.

    Those of the second table run in Triton's interpreter with the slow tests alone.
    """
    params = [
        pytest.param(target.values[0], case, id=f"{target.id}, {name}", marks=target.marks)
        for targets, table in ((ALL_KERNELS, cases), (_SELDOM, seldom_interpreted))
        for target in targets
        for name, case in table.items()
    ]
    return pytest.mark.parametrize(("kernels", "case"), params, indirect=["kernels"])


COMPILED = pytest.mark.parametrize("kernels", [_NUMBA, _CARD], indirect=True)


def skip_unless_there(target: Target) -> None:
    """Skip the test where the backend is not installed, or is for a card alone."""
    if not BACKENDS[target.backend].is_installed():
        pytest.skip(f"{target.backend} is not installed")
    if target.interpreted and os.environ.get("TRITON_INTERPRET") != "1":
        pytest.skip("Triton's interpreter is off")


def move(value: Any, device: torch.device, dtype: torch.dtype | None = None) -> Any:
    """Tensors, Gaussians, footprints or pinhole cameras on a device, without a graph."""
    if isinstance(value, Tensor):
        return value.detach().to(device, dtype if value.is_floating_point() else None)
    if isinstance(value, PinholeCamera):
        parts = (value.intrinsics, value.extrinsics, value.height, value.width)
        return PinholeCamera(*(move(x, device, dtype) for x in parts))
    tensors = {name: x for name, x in vars(value).items() if isinstance(x, Tensor)}
    return dataclasses.replace(value, **{name: move(x, device, dtype) for name, x in tensors.items()})


# -- Triton's interpreter --------------------------------------------------------------------------------------------


def speed_up_interpreter(patch: pytest.MonkeyPatch) -> None:
    """Without what takes most of the interpreter's time; on another version of Triton it stays as slow as it is.

    It scans element by element, here row by row. It searches Triton's language for what to replace in each call of a
    function that a kernel calls, here once in each launch for each module. It looks for integers that overflow, and
    does nothing about them.
    """
    with suppress(ImportError, AttributeError):
        from triton.runtime import interpreter

        patch.setattr(interpreter.ScanOps, "generic_scan", _scan)
        options = dataclasses.replace(interpreter.interpreter_builder.options, sanitize_overflow=False)
        patch.setattr(interpreter.interpreter_builder, "options", options)
        replace, launch, modules = interpreter._patch_lang, interpreter.GridExecutor.__call__, set()
        nothing = interpreter._LangPatchScope

        def replace_once(function: Any) -> Any:
            module = id(function.__globals__)
            if module in modules:
                return nothing()
            modules.add(module)
            return replace(function)

        def first(self: Any, *arguments: Any, **options: Any) -> Any:
            modules.clear()
            return launch(self, *arguments, **options)

        patch.setattr(interpreter, "_patch_lang", replace_once)
        patch.setattr(interpreter.GridExecutor, "__call__", first)


def _scan(self: Any, values: Any) -> Any:
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
