"""Work for the grid that notes what happens; imports nothing heavy, for the processes that do it."""

import os
import signal
import time
from collections import Counter
from pathlib import Path


def cells_in(log, count, kill=None, seconds=0.2):
    """Cells that note in the folder `log`; `kill`: which of them kill their process or fail, {x: "once", "always" or
    "fail"}."""
    kill = kill or {}
    return [{"x": x, "log": str(log), "seconds": seconds, "kill": kill.get(x)} for x in range(count)]


def do(cell):
    log = Path(cell["log"])
    (log / f"process {os.getpid()}").write_text(str(cell["x"]))
    time.sleep(cell["seconds"])
    if cell["kill"] == "fail":
        raise ArithmeticError("three")
    killed = log / f"killed {cell['x']}"
    if cell["kill"] == "always" or (cell["kill"] == "once" and not killed.exists()):
        killed.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    with (log / "done").open("a") as file:
        file.write(f"{cell['x']}\n")
    return {"y": cell["x"] ** 2}


def threads_of_torch(_):
    """Which process did the cell, and on how many threads torch works there."""
    import torch

    time.sleep(0.5)
    return {"process": os.getpid(), "threads": torch.get_num_threads()}


def times_done(log):
    """How often each cell came to its end."""
    return Counter(int(line) for line in (log / "done").read_text().split())


def processes_left(log):
    """The processes that did a cell and do not end within ten seconds."""
    pids = [int(path.name.split()[1]) for path in log.glob("process *")]
    until = time.monotonic() + 10
    while (left := [pid for pid in pids if _is_there(pid)]) and time.monotonic() < until:
        time.sleep(0.05)
    return left


def _is_there(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
