"""What a machine refuses, for tests."""

from contextlib import contextmanager

import pytest


@contextmanager
def limited(size):
    """No file of this process, and of those that it starts, can be larger: to a program as if the disk were full."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
