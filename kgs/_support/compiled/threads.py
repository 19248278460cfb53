"""Calls a kernel on ranges, on plain Python threads: kernels release the GIL, and numba's own threads are not used."""

import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import SimpleQueue
from threading import Thread
from typing import Any

_MIN = 8192  # numbers or rows of a range: below that a second thread costs more than it gains


@dataclass(frozen=True)
class _Work:
    """The ranges still to do, and for each finished one None or its error."""

    ranges: deque[tuple[int, int]]
    kernel: Callable[..., None]
    arguments: tuple[Any, ...]
    done: SimpleQueue[BaseException | None] = field(default_factory=SimpleQueue)

    def drain(self) -> None:
        """Process ranges until no thread has any left to start."""
        while True:
            try:
                begin, end = self.ranges.popleft()
            except IndexError:
                return
            try:
                self.kernel(begin, end, *self.arguments)
            except BaseException as error:  # raised by the caller, when nothing runs any more
                self.done.put(error)
            else:
                self.done.put(None)


_helpers: list[SimpleQueue[_Work]] = []  # a queue of each thread


def parallel_for(
    threads: int, count: int, kernel: Callable[..., None], *arguments: Any, pieces: int | None = None
) -> None:
    """Call `kernel(begin, end, *arguments)` on ranges that make up 0 .. count, on at most `threads` threads.

    The ranges do not depend on the number of threads: the last turns of a vector loop are scalar and may round
    differently, which would show in the bits. A thread that wakes up when all ranges are taken is not waited for.

    Args:
        threads: the calling one included.
        count: what is divided.
        kernel: releases the GIL, and writes only what belongs to its range.
        arguments: of the kernel, behind the range.
        pieces: how many ranges; None goes by `count`.
    """
    step = max(1, -(-count // (pieces or max(1, min(16, count // _MIN)))))
    if step >= count:
        if count:
            kernel(0, count, *arguments)
        return
    work = _Work(deque((begin, min(begin + step, count)) for begin in range(0, count, step)), kernel, arguments)
    total = len(work.ranges)
    for helper in range(min(threads, total) - 1):
        if helper == len(_helpers):
            queue: SimpleQueue[_Work] = SimpleQueue()
            _helpers.append(queue)
            Thread(target=_serve, args=(queue,), name=f"kgs-compiled-{helper}", daemon=True).start()
        _helpers[helper].put(work)
    work.drain()
    errors = [error for error in (work.done.get() for _ in range(total)) if error is not None]
    if errors:
        raise errors[0]


def _serve(queue: "SimpleQueue[_Work]") -> None:
    while True:
        queue.get().drain()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.clear)
