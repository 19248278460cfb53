"""How kernels are called.

Triton looks at every argument of every call for what the kernel is to be compiled for, which takes longer than small
kernels run. On NVIDIA's and AMD's GPUs `launch` therefore keeps what Triton compiled, by :func:`specialization`, and
gives it the pointers from the second call on. What the environment says to Triton counts when a kernel is first called.
"""

import functools
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor

_DIRECT = ("cuda",)  # types of devices; what Triton compiles for on Intel's is not known here
_HOOKS = ("launch_enter_hook", "launch_exit_hook", "add_stages_inspection_hook")
_MAX_SMALL = 2**31 - 1  # bytes; kernels for AMD's GPUs address tensors of more than that otherwise
_IS_AMD = torch.version.hip is not None
_NOTHING = nullcontext[None]()

_recorded: ContextVar["list[Launch] | None"] = ContextVar("_recorded", default=None)  # see `recorded_launches`
_compiled: dict[Any, tuple[Any, ...]] = {}  # by the key of `specialization`: what is called, and what has to stay
_arguments: dict[int, tuple[Any, tuple[bool, ...]]] = {}  # by its id a kernel, which thereby stays, and see below


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, warps: int = 4, **constants: Any) -> None:
    """Run a kernel on the device of its first tensor; nothing is waited for.

    Args:
        kernel: of one of the modules `X_kernels`.
        grid: how many programs, along at most three axes; nothing happens where one is 0.
        arguments: of the kernel, in their order: tensors, which are contiguous, and numbers.
        warps: of each program.
        constants: arguments that the kernel is compiled for, in their order, behind all others.
    """
    if 0 in grid:
        return
    device = _device_of(arguments)
    if device.type not in _DIRECT or _is_watched(kernel):
        with current(device):
            _launch_by_triton(kernel, grid, arguments, warps, constants)
        return
    key, values = specialization(kernel, arguments, (device.index, warps, *constants.items()))
    known = _compiled.get(key)
    with current(device):
        if known is None:
            compiled = _launch_by_triton(kernel, grid, arguments, warps, constants)
            if key is not None and all(hasattr(compiled, x) for x in ("run", "function", "packed_metadata")):
                _compiled[key] = (compiled.run, compiled.function, compiled.packed_metadata, compiled)
            return
        if hasattr(kernel, "device_caches"):  # since Triton 3.3
            values += constants.values()
        run, function, metadata, _ = known
        nothing = (None, None, None)  # for hooks
        run(*(*grid, 1, 1)[:3], _stream(device), function, metadata, *nothing, *values)


class Launch(NamedTuple):
    """What :func:`launch` was called with."""

    kernel: Any
    grid: tuple[int, ...]
    arguments: tuple[Any, ...]
    warps: int
    constants: dict[str, Any]

    @property
    def options(self) -> dict[str, Any]:
        """What Triton takes by name."""
        # products are fused with sums, in every version of Triton: from 3.10 on it is not the default
        return {**self.constants, "num_warps": self.warps, "enable_fp_fusion": True}

    @property
    def key(self) -> Any:
        """See :func:`specialization`."""
        return specialization(self.kernel, self.arguments, (self.warps, *self.constants.items()))[0]


@contextmanager
def recorded_launches() -> Iterator[list[Launch]]:
    """List what this thread launches on a CPU; nothing is launched there."""
    launches: list[Launch] = []
    token = _recorded.set(launches)
    try:
        yield launches
    finally:
        _recorded.reset(token)


def specialization(kernel: Any, arguments: tuple[Any, ...], rest: tuple[Any, ...]) -> tuple[Any, list[Any]]:
    """A key that differs where Triton would compile a kernel again, and the arguments with pointers for tensors.

    Triton compiles for the dtype of a tensor and whether its pointer is a multiple of 16, for integers of 32 and 64
    bits and, unless a kernel says `do_not_specialize`, for those that are 1 or a multiple of 16; on AMD's GPUs for
    small tensors, too.

    Args:
        kernel: as Triton's `jit` returns it.
        arguments: that are not constants.
        rest: what else goes into the key.

    Returns:
        The key is None where an argument is neither a tensor nor a number.
    """
    key: list[Any] = [id(kernel), *rest]
    values: list[Any] = []
    for value, as_it_is in zip(arguments, _not_specialized(kernel), strict=False):
        kind = type(value)
        if kind is int:
            key.append(_kind_of_integer(value, as_it_is))
        elif kind is float or kind is bool:
            key.append(kind)
        elif isinstance(value, Tensor):
            if _IS_AMD:
                key.append(value.untyped_storage().nbytes() <= _MAX_SMALL)
            dtype = value.dtype
            value = value.data_ptr()
            key.append((dtype,) if value % 16 else dtype)
        else:
            return None, values
        values.append(value)
    return tuple(key), values


def _kind_of_integer(value: int, as_it_is: bool) -> int:
    """The bits of the type that Triton gives it, negative with a sign; 2 more for 1, or 1 more for a multiple of 16."""
    bits = -32 if -(2**31) <= value < 2**31 else 64 if value >= 2**63 else -64
    if as_it_is:
        return bits
    return bits + (2 if value == 1 else 0 if value % 16 else 1)


def _launch_by_triton(
    kernel: Any, grid: tuple[int, ...], arguments: tuple[Any, ...], warps: int, constants: dict[str, Any]
) -> Any:
    """Launch as Triton documents it; returns what was compiled, or None."""
    called = Launch(kernel, grid, arguments, warps, constants)
    recorded = _recorded.get()
    if recorded is None:
        return kernel[grid](*arguments, **called.options)
    recorded.append(called)
    return None


def _is_watched(kernel: Any) -> bool:
    """Whether something wants to hear of each launch, as a profiler does: Triton tells it."""
    if kernel.pre_run_hooks:
        return True
    settings = _settings()
    for name in _HOOKS:
        hook = getattr(settings, name, None)
        if hook is not None and getattr(hook, "calls", True):
            return True
    return False


@functools.cache
def _settings() -> Any:
    """What has the hooks of Triton."""
    if hasattr(triton, "knobs"):  # since Triton 3.4
        return triton.knobs.runtime
    return triton.compiler.CompiledKernel


def _not_specialized(kernel: Any) -> tuple[bool, ...]:
    """Of each argument of a kernel whether its value is left aside."""
    known = _arguments.get(id(kernel))  # the hash of a kernel is that of its source
    if known is None:
        known = (kernel, tuple(x.do_not_specialize for x in kernel.params))
        _arguments[id(kernel)] = known
    return known[1]


def wide_sum(values: Tensor, dim: int) -> Tensor:
    """The sum along a dimension in float64, in float32 where that may be missing."""
    return values.sum(dim, dtype=torch.float64 if has_float64(values.device) else torch.float32)


def has_float64(device: torch.device) -> bool:
    """Whether numbers may be added up in float64; not on Intel's GPUs, some of which have none."""
    return device.type != "xpu"


def blocks(count: int, size: int) -> int:
    """How many blocks of a size cover a count."""
    return -(-count // size)


def _device_of(arguments: tuple[Any, ...]) -> torch.device:
    """The device of the first tensor."""
    for value in arguments:
        if isinstance(value, Tensor):
            return value.device
    raise TypeError("launch: expected a tensor among the arguments, got none")


def _stream(device: torch.device) -> int:
    """The stream on which torch works."""
    stream: int = triton.runtime.driver.active.get_current_stream(device.index)
    return stream


def current(device: torch.device) -> AbstractContextManager[Any]:
    """Makes the device the current one, where there are several of its kind: Triton launches on that one."""
    if device.type == "cpu" or device.index is None or _is_alone(device.type):
        return _NOTHING
    module = torch.get_device_module(device)
    if device.index == module.current_device():
        return _NOTHING
    context: AbstractContextManager[Any] = module.device(device.index)
    return context


@functools.cache
def _is_alone(kind: str) -> bool:
    """Whether there is one device of a kind."""
    count: int = torch.get_device_module(kind).device_count()
    return count == 1
