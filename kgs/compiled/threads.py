"""Calls a kernel on ranges, on plain Python threads: kernels release the GIL, and numba's own threads are not used."""

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

_LEAST = 8192  # numbers or rows of a range: below that a second thread costs more than it gains
_pools: dict[int, ThreadPoolExecutor] = {}


def over(threads: int, count: int, kernel: Callable[..., None], *arguments: Any, pieces: int | None = None) -> None:
    """Call `kernel(begin, end, *arguments)` on ranges that make up 0 .. count, on at most `threads` threads.

    The ranges do not depend on the number of threads: the last turns of a vector loop are scalar and may round
    differently, which would show in the bits.

    Args:
        threads: the calling one included.
        count: what is divided.
        kernel: releases the GIL, and writes only what belongs to its range.
        arguments: of the kernel, behind the range.
        pieces: how many ranges; None goes by `count`.
    """
    step = max(1, -(-count // (pieces or max(1, min(16, count // _LEAST)))))
    if step >= count:
        if count:
            kernel(0, count, *arguments)
        return
    ranges = deque((begin, min(begin + step, count)) for begin in range(0, count, step))

    def drain() -> None:
        while True:
            try:
                begin, end = ranges.popleft()
            except IndexError:
                return
            try:
                kernel(begin, end, *arguments)
            except BaseException:
                ranges.clear()
                raise

    futures = [_pool(threads).submit(drain) for _ in range(min(threads, len(ranges)) - 1)]
    try:
        drain()
    finally:
        wait(futures)  # all of them, so that nothing runs on after an error
    for future in futures:
        future.result()


def _pool(threads: int) -> ThreadPoolExecutor:
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads - 1, thread_name_prefix="kgs-compiled")
    return _pools[threads]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)
