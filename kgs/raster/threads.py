"""Runs independent pieces of CPU work on plain Python threads, each with one intra-op thread.

Torch releases the GIL inside its operators, and an operator on an L2-sized buffer is too short to be worth an OpenMP
barrier: whole groups side by side gain 1.7x on two cores where intra-op threads gain 1.2x. One thread computes a piece
from begin to end, so results do not depend on their number. `torch.set_num_threads` acts on the calling thread; the
default for threads born later is shared, and put back at once.
"""

import os
import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TypeVar

import torch

Item = TypeVar("Item")
_pools: dict[int, ThreadPoolExecutor] = {}


def run_all(
    items: Iterable[Item], make_worker: Callable[[], Callable[[Item], None]], device: torch.device, most: int = 2**16
) -> None:
    """Call a worker on every item, in order, on as many threads as torch has, but at most so many; one for a GPU.

    `make_worker` is called once per thread and returns the function that does one item (a place for its buffers).
    """
    queue = deque(items)
    threads = torch.get_num_threads() if device.type == "cpu" else 1
    inference = torch.is_inference_mode_enabled()

    def drain() -> None:
        # all of these are states of a thread
        with torch.inference_mode(inference), torch.no_grad(), torch.autocast(device.type, enabled=False):
            worker = make_worker()
            while True:
                try:
                    item = queue.popleft()
                except IndexError:
                    return
                try:
                    worker(item)
                except BaseException:
                    queue.clear()
                    raise

    if threads == 1 or not queue:
        drain()
        return
    futures = [_pool(threads).submit(drain) for _ in range(min(threads, most, len(queue)))]
    wait(futures)  # all of them, so that nothing runs on after an error
    for future in futures:
        future.result()


def _pool(threads: int) -> ThreadPoolExecutor:
    if threads not in _pools:
        before = torch.get_num_threads()
        started = threading.Barrier(threads + 1)

        def start() -> None:
            torch.get_num_threads()  # a new thread takes over the default at its first use, which would undo the next
            torch.set_num_threads(1)
            started.wait()

        pool = ThreadPoolExecutor(threads, thread_name_prefix="kgs", initializer=start)
        for _ in range(threads):
            pool.submit(lambda: None)
        started.wait()
        torch.set_num_threads(before)
        _pools[threads] = pool
    return _pools[threads]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)
