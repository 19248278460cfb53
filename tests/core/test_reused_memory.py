"""Memory that is used again."""

import os
import signal
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

import kgs._support.memory
from kgs._support.memory import array

LARGE = (1000, 100)


def address(values):
    return values.ctypes.data


@pytest.fixture(autouse=True)
def nothing_is_free(monkeypatch):
    monkeypatch.setattr(kgs._support.memory, "_free", [])


@pytest.mark.parametrize(
    "keep",
    [None, lambda values: values[10:], torch.from_numpy, lambda values: torch.from_numpy(values)[:, 3]],
    ids=["nothing", "view", "tensor", "part of a tensor"],
)
def test_memory_is_used_again_unless_it_is_still_seen(keep):
    first = array(LARGE)
    where = address(first)
    kept = keep(first) if keep else None
    del first
    assert (address(array((900, 100))) == where) is (keep is None)
    del kept


@pytest.mark.parametrize(
    ("shape", "dtype"), [(LARGE, np.float32), (100_001, np.int32), ((3, 7), np.int64), (0, np.float32)]
)
def test_arrays_have_the_shape_and_begin_at_a_cache_line(shape, dtype):
    values = array(shape, dtype)
    assert values.shape == np.empty(shape, dtype).shape
    assert values.dtype == dtype
    assert values.nbytes < 2**16 or address(values) % 64 == 0
    values[...] = 1


def test_threads_do_not_get_the_same_memory():
    def work(number):
        for _ in range(50):
            values = array(LARGE)
            values[:] = number
            assert (values == number).all()
        return number

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(4))) == [0, 1, 2, 3]


def test_what_is_kept_is_bounded(monkeypatch):
    monkeypatch.setattr(kgs._support.memory, "_KEPT", 2**20)
    arrays = [array(LARGE) for _ in range(10)]
    del arrays
    assert 0 < sum(map(len, kgs._support.memory._free)) <= 2**20


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_child_forked_while_a_thread_takes_memory_can_take_some():
    taken = threading.Event()

    def take():
        with kgs._support.memory._lock:
            taken.set()
            threading.Event().wait(0.2)

    thread = threading.Thread(target=take)
    thread.start()
    taken.wait()
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        array(LARGE)
        os._exit(0)
    thread.join()
    assert os.waitpid(child, 0)[1] == 0
