"""Where the cells of a grid run: in local processes, or on the workers of a Dask scheduler."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from multiprocessing.connection import Connection
from typing import Any

__all__ = ["LOST", "Cell", "Places", "Result", "dask_workers", "local_processes"]

Cell = dict[str, Any]
Result = dict[str, Any]
# Starts a cell, and says how many may run at a time just now.
Places = tuple[Callable[[Cell], "Future[Result]"], Callable[[], int]]
LOST = "scheduler: expected it to stay until the last cell, got a lost connection; run again to go on"
_PATIENCE = 10  # seconds for a scheduler to answer


@contextmanager
def local_processes(work: Callable[[Cell], Result], processes: int) -> Iterator[Places]:
    """Local processes, each the only one of its pool, so that one that dies breaks the pool for its own cell alone."""
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    cores = max(1, (os.cpu_count() or 1) // processes)
    own = threading.local()

    def attempt(cell: Cell) -> Result:
        if not hasattr(own, "pool"):
            pool = ProcessPoolExecutor(1, context, initializer=_begin, initargs=(cores, theirs))
            own.pool = pools.enter_context(pool)
        try:
            result: Result = own.pool.submit(work, cell).result()
        except BrokenProcessPool:
            del own.pool
            raise
        return result

    def run(cell: Cell) -> Result:
        try:
            return attempt(cell)
        except BrokenProcessPool:
            if ours.closed:
                raise
            return attempt(cell)

    with theirs, ExitStack() as pools:
        threads = ThreadPoolExecutor(processes)
        try:
            yield lambda cell: threads.submit(run, cell), lambda: processes
        finally:
            ours.close()  # ends the processes, whatever they are doing
            threads.shutdown(cancel_futures=True)


def _begin(cores: int, parent: Connection) -> None:
    """What a local process does first: it will end with its parent, however that ends, and leaves Ctrl-C to it."""

    def leave() -> None:
        with suppress(EOFError, OSError):
            parent.recv()
        os._exit(1)

    threading.Thread(target=leave, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    import torch

    torch.set_num_threads(min(cores, torch.get_num_threads()))  # OMP_NUM_THREADS may ask for fewer


@contextmanager
def dask_workers(work: Callable[[Cell], Result], address: str, say: Callable[[str], None]) -> Iterator[Places]:
    """The workers of a Dask scheduler; leaving it closes the client, and with it goes all that waits or runs there."""
    from distributed import Client

    try:
        with ThreadPoolExecutor(1) as thread:  # the loop of a notebook has this one
            kind = thread.submit(asyncio.run, _identify(address)).result()
        if kind != "Scheduler":
            raise ValueError(f"this is a {kind}")
    except Exception as error:  # whatever Dask makes of what answers there, from a typing error to a web server
        raise ValueError(
            "scheduler: expected the address of a running Dask scheduler, as tcp://127.0.0.1:8786, "
            f"got {address!r} ({str(error) or 'no answer'})"
        ) from None
    client = Client(address, timeout=_PATIENCE, set_as_default=False)
    known = -1

    def limit() -> int:
        nonlocal known
        try:
            workers: dict[str, int] = client.nthreads()
        except OSError:
            raise ConnectionError(LOST) from None
        threads = sum(workers.values())
        if threads != known:
            shared = "; cells share a process, which falsifies their CPU seconds: see --nthreads 1"
            say(f"worker threads at {address}: {threads}{shared if threads > len(workers) else ''}")
            known = threads
        return threads

    with closing(client):
        # without retries: they are for cells that raise; one whose worker dies is done again anyway
        executor = client.get_executor(pure=False)
        yield lambda cell: executor.submit(work, cell), limit


async def _identify(address: str) -> str:
    """What answers there. A Client would wait for ever for a port that is open and says nothing, as the dashboard's."""
    from distributed.core import rpc
    from distributed.security import Security

    async with rpc(address, timeout=_PATIENCE, connection_args=Security().get_connection_args("client")) as server:
        identity = await asyncio.wait_for(server.identity(), _PATIENCE)
    return str(identity["type"])
