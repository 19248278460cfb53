"""How many threads torch's own operators use, where kernels do most of the work."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import local

import torch

_limits = local()  # its `kernels`, where torch itself has fewer threads


def thread_count() -> int:
    """How many threads kernels use: as many as torch, or as it had before :func:`torch_on_one_thread`."""
    return getattr(_limits, "kernels", None) or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Torch's own operators run on one thread here, kernels on as many as before.

    How torch divides an operator depends on its number of threads, and what is last in a part may be rounded in another
    way: the bits of a fit would depend on it. And a thread of torch that waits for the next operator takes the time of
    a kernel's.
    """
    before = torch.get_num_threads()
    outer = getattr(_limits, "kernels", None)
    _limits.kernels = outer or before
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        _limits.kernels = outer


@contextmanager
def torch_on_all_threads() -> Iterator[None]:
    """Within :func:`torch_on_one_thread`: torch on all threads again, for what gives the same bits on any number."""
    before = torch.get_num_threads()
    torch.set_num_threads(thread_count())
    try:
        yield
    finally:
        torch.set_num_threads(before)
