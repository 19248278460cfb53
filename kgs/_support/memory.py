"""Memory for large arrays and tensors that live for one step, used again by the next.

Fresh memory is mapped page by page when it is first touched, which took a quarter of a training step where two threads
did it at once. A block is free again when the last array in it is gone.
"""

import math
import os
import weakref
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor

_LINE = 64  # bytes of a cache line, at which arrays begin
_MIN = 2**16  # smaller blocks are quick to get
_MAX = 2**26  # larger ones are not kept
_KEPT = 2**28  # bytes of all free blocks
_WASTE = 1.5  # a block may be so many times larger than what is wanted
_MARGIN = 1.1  # new blocks are larger than asked for, because the number of Gaussians grows
_free: list[np.ndarray[Any, Any]] = []
_lock = Lock()
if hasattr(os, "register_at_fork"):  # the child of a fork has no thread that could release it
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)


def array(shape: int | tuple[int, ...], dtype: Any = np.float32) -> np.ndarray[Any, Any]:
    """`np.empty` that begins at a cache line, in memory of an array that is gone, if there is any."""
    kind = np.dtype(dtype)
    count = math.prod(shape) if isinstance(shape, tuple) else int(shape)
    size = count * kind.itemsize
    if not _MIN <= size <= _MAX:
        return np.empty(shape, kind)
    block = _block(size + _LINE)
    flat = np.frombuffer(block.data, kind, count, -block.ctypes.data % _LINE)
    weakref.finalize(flat, _give_back, block).atexit = False
    return flat.reshape(shape)


def _block(size: int) -> np.ndarray[Any, Any]:
    with _lock:
        fitting = (i for i, block in enumerate(_free) if size <= len(block) <= _WASTE * size)
        i = next(fitting, None)
        if i is not None:
            return _free.pop(i)
        while sum(map(len, _free)) > _KEPT // 2:  # sizes have changed: what is oldest fits no longer
            del _free[0]
    return np.empty(math.ceil(_MARGIN * size), np.uint8)


def _give_back(block: np.ndarray[Any, Any]) -> None:
    """Keep a block where there is room; only append, for garbage collection may call this within `_block`."""
    if sum(map(len, _free)) + len(block) <= _KEPT:
        _free.append(block)


def empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    """`like.new_empty(shape)`; on a CPU in the memory of an array that is gone, if there is any."""
    if like.device.type != "cpu" or torch.compiler.is_compiling():
        return like.new_empty(shape)
    return torch.from_numpy(array(shape, str(like.dtype).removeprefix("torch.")))
