"""A fit that a user waits for: it shows its progress, writes checkpoints, and ends early at a signal."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from kgs.datasets.scene import Scene
from kgs.fit.config import FitConfig
from kgs.fit.fit import Fit
from kgs.fit.run import Hooks, fit_scene
from kgs.fit.trainer import Trainer

from .console import each, progress

_SAVE_SECONDS = 60.0


class Training:
    """One call of :func:`fit_scene`, with a progress line and checkpoints each minute, at evaluations and at the end.

    SIGINT (Ctrl-C), SIGTERM and SIGHUP end the training after the current step. If a checkpoint cannot be written (a
    full disk), a note says so the first time, and training goes on.

    Args:
        checkpoint: the file; None: none is written.
        title: of the progress line.
        begun: called with the trainer before the first step.

    Attributes:
        trainer: of the fit; None until it has begun.
    """

    def __init__(
        self, checkpoint: Path | None = None, title: str = "fit", begun: Callable[[Trainer], None] | None = None
    ) -> None:
        self.trainer: Trainer | None = None
        self._checkpoint = checkpoint
        self._title = title
        self._begun = begun
        self._received: list[int] = []
        self._saved = 0.0
        self._has_failed = False
        self._advance: Callable[..., None]
        self._until_the_end = ExitStack()

    @property
    def signal(self) -> int:
        """The number of the signal that ended the training, or 0."""
        return self._received[0] if self._received else 0

    def fit(self, scene: Scene, config: FitConfig, resume: Path | None = None) -> tuple[Trainer, Fit]:
        """Fit the scene, or go on from a checkpoint; the trainer, and the pruned fit. Errors: those of `fit_scene`."""
        hooks = Hooks(bar=each, begun=self._begin, after_step=self._after_step, done=self._end)
        with self._until_the_end:
            fit = fit_scene(scene, config, resume=resume, hooks=hooks)
        assert self.trainer is not None
        return self.trainer, fit

    def _begin(self, trainer: Trainer) -> None:
        self.trainer = trainer
        if self._begun is not None:
            self._begun(trainer)
        self._saved = time.monotonic()
        self._until_the_end.enter_context(_interruptible(self._received))
        bar = progress(trainer.plan.schedule.steps, self._title, trainer.step)
        self._advance = self._until_the_end.enter_context(bar)

    def _after_step(self, trainer: Trainer, loss: float) -> bool:
        self._advance(f"loss={loss:.4f}, {len(trainer.model)} Gaussians")
        if trainer.step in trainer.plan.schedule.evaluate or time.monotonic() - self._saved > _SAVE_SECONDS:
            self._save(trainer)
        return bool(self._received)

    def _end(self, trainer: Trainer, fit: Fit) -> None:
        self._save(trainer, fit.part)

    def _save(self, trainer: Trainer, part: dict[str, Any] | None = None) -> None:
        self._saved = time.monotonic()
        if self._checkpoint is None:
            return
        try:
            trainer.save(self._checkpoint, part)
        except OSError as error:
            if not self._has_failed:  # the next one is tried a minute later: no line for each
                trainer.state.note(f"step {trainer.step}: no checkpoint: {error}")
            self._has_failed = True


@contextmanager
def _interruptible(received: list[int]) -> Iterator[None]:
    """Record SIGINT, SIGTERM and SIGHUP in a list; a second one acts as usual.

    Ignored signals (nohup) stay ignored, and only the main thread can handle any.
    """
    usual: dict[int, Any] = {}  # the handlers that are replaced
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            handler = None if number is None else signal.getsignal(number)
            if number is not None and handler not in (None, signal.SIG_IGN):
                usual[number] = handler

    def record(number: int, _: object) -> None:
        received.append(number)
        signal.signal(number, usual[number])

    for number in usual:
        signal.signal(number, record)
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
