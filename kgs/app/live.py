"""The page of `kgs fit --live`: takes the splat out of the training loop now and then, and says how far the fit is."""

import time
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any, Self, TypeVar

import torch

from kgs._support.torch_threads import torch_on_one_thread
from kgs.fit.fit import Fit
from kgs.fit.trainer import Trainer
from kgs.geometry.types import Gaussians
from kgs.model import GaussianModel

from .live_server import LiveServer
from .page.data import pack_float32
from .page.fit_page import live_page

_PAUSE = 2.0  # least seconds between two splats
_SHARE = 0.015  # largest share of the time of the fit that the page takes, by the clock and of the processor
_SOME = 5000  # Gaussians that tell where the scene is
T = TypeVar("T")


class LivePage:
    """A page on this machine with the splat of a fit, until the end of its `with` block. It changes no bit of the fit.

    No step costs anything while no page is open. A splat is copied between two steps; threads of the server do the
    rest.

    Args:
        trainer: before its next step.
        title: of the page.
        roll: degrees by which all pictures are turned clockwise.

    Raises:
        OSError: the system gives no port.

    Attributes:
        url: of the page.
        end: what the page says at last if the block ends without an exception.
    """

    def __init__(self, trainer: Trainer, title: str, roll: float) -> None:
        gaussians = _copied(trainer.model)
        some = gaussians[:: max(1, len(gaussians) // _SOME)]
        self._steps = trainer.plan.schedule.steps
        self._begin = _clocks()
        self._shown = float("-inf")  # time of the last splat
        self._seconds = 0.0  # processor time that copies took
        self._server = LiveServer(partial(_alone, live_page, trainer.result(), some, title, roll))
        self._server.show(self._words(trainer.step, len(trainer.model)), partial(_alone, pack_float32, gaussians))
        self.url = self._server.url
        self.end = "The fit is done."

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._server.close(self.end)
        elif issubclass(kind, KeyboardInterrupt):
            self._server.close("The fit was interrupted.")
        else:
            self._server.close("The fit has failed: its last line in the terminal says why.")

    def after_step(self, trainer: Trainer) -> None:
        """Show the splat if a page waits for it, and it is time."""
        if not self._server.is_awaited:
            return
        if time.monotonic() - self._shown < _PAUSE:
            return
        passed = min(now - begin for now, begin in zip(_clocks(), self._begin, strict=True))
        if self._seconds + self._server.seconds <= _SHARE * passed:
            self._show(trainer.model, self._words(trainer.step, len(trainer.model)))

    def after_training(self, fit: Fit) -> None:
        """Show the splat of a fit that is trained and pruned."""
        words = self._words(fit.history["steps"], len(fit.model))
        self._show(fit.model, f"{words}: film and page are being written.")

    def _show(self, model: GaussianModel, text: str) -> None:
        self._shown = time.monotonic()
        begin = time.thread_time()
        gaussians = _copied(model)
        self._seconds += time.thread_time() - begin
        self._server.show(text, partial(_alone, pack_float32, gaussians))

    def _words(self, step: int, count: int) -> str:
        """As "step 300 of 900, 41 000 Gaussians"."""
        grouped = f"{count:,}".replace(",", "\N{NO-BREAK SPACE}")
        return f"step {step} of {self._steps}, {grouped} Gaussians"


def _clocks() -> tuple[float, float]:
    """The time, and the processor time of all threads, both in seconds: where other programs run, a fit gets less."""
    return time.monotonic(), time.process_time()


def _copied(model: GaussianModel) -> Gaussians:
    """The Gaussians on the CPU, in memory of their own."""
    with torch.no_grad():
        return _alone(lambda: Gaussians(*(value.to("cpu", copy=True) for value in vars(model()).values())))


def _alone(make: Callable[..., T], *arguments: Any) -> T:
    """What a function returns, with torch on one thread: a second one would take the time of a kernel's."""
    with torch_on_one_thread():
        return make(*arguments)
