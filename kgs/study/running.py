"""How far the running cells are: told by the Dask workers that do them, shown where the grid was started."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any

from distributed import Client, get_worker

from kgs.app.console import say

if TYPE_CHECKING:
    from kgs.fit.trainer import Trainer

TOPIC = "kgs-study-steps"  # of the scheduler's events
SECONDS = 2.0  # between two messages of a cell
_SHOWN = 4  # lines of a cell where there is no terminal, one of them its end


def tell_steps() -> "Callable[[Trainer, float], bool] | None":
    """A callback for `Trainer.fit` that tells the grid every two seconds how far it is; None: this is no Dask worker.

    The worker's own thread sends the message; the fit waits for nothing.
    """
    try:
        worker = get_worker()
        key = worker.get_current_task()
    except (ValueError, KeyError):  # no worker; or no task of it
        return None
    last = -math.inf

    def tell(trainer: "Trainer", _: float) -> bool:
        nonlocal last
        now = time.monotonic()
        if now - last >= SECONDS:
            last = now
            with suppress(RuntimeError):  # the worker is closing
                worker.log_event(TOPIC, {"key": key, "step": trainer.step, "steps": trainer.plan.schedule.steps})
        return False

    return tell


@dataclass
class _Cell:
    name: str
    bar: Any  # of tqdm, or None
    quarter: int = 0  # of its steps, the last one that was shown


class Running:
    """Shows the running cells on stderr: a bar for each on a terminal, else a line for each quarter of their steps.

    `print_line` takes a line of text for the user.
    """

    def __init__(self, print_line: Callable[[str], None] = print) -> None:
        self._print_line = print_line
        self._cells: dict[Any, _Cell] = {}
        self._lock = Lock()  # messages come in a thread of the client
        self._bar: Any = None  # tqdm's class, where bars are shown
        with suppress(OSError, ValueError, AttributeError, ImportError):  # no tqdm, or a stderr that is closed
            if sys.stderr.isatty():
                from tqdm import tqdm

                self._bar = tqdm

    def begin(self, key: Any, name: str) -> None:
        """A cell was given to a worker: the task's key, and a name for the user."""
        with self._lock:
            bar = None if self._bar is None else self._bar(desc=name, unit="step", leave=False, file=sys.stderr)
            self._cells[key] = _Cell(name, bar)

    def end(self, key: Any) -> None:
        """It is done, or has failed."""
        with self._lock:
            cell = self._cells.pop(key)
            if cell.bar is not None:
                with suppress(OSError, ValueError):
                    cell.bar.close()

    def hear(self, event: tuple[float, dict[str, Any]]) -> None:
        """Show a message of `tell_steps`; that of a cell which is done already is left out."""
        _, told = event
        with self._lock:
            cell = self._cells.get(told["key"])
            if cell is None:
                return
            if cell.bar is not None:
                with suppress(OSError, ValueError):
                    if cell.bar.total is None or told["step"] < cell.bar.n:  # it begins, or begins again elsewhere
                        cell.bar.reset(total=told["steps"])
                    cell.bar.update(told["step"] - cell.bar.n)
                return
            quarter = _SHOWN * told["step"] // told["steps"]
            if cell.quarter < quarter < _SHOWN:
                say(f"{cell.name}: {told['step']} of {told['steps']} steps", sys.stderr)
            cell.quarter = quarter

    def say(self, line: str) -> None:
        """Print a line, for which the bars make room."""
        with self._lock, nullcontext() if self._bar is None else self._bar.external_write_mode():
            self._print_line(line)

    @contextmanager
    def listening(self, client: Client) -> Iterator[None]:
        """While the client's workers do cells; what is left on the terminal is removed in the end."""
        client.subscribe_topic(TOPIC, self.hear)
        try:
            yield
        finally:
            for key in list(self._cells):
                self.end(key)
