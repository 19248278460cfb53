"""DropGaussian: switch Gaussians off at random in training and scale up the rest.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: o_i <- M_i o_i with M_i = 1/(1 - r) for kept and 0 for dropped Gaussians, r_t = gamma t / T.

The layer needs nothing but torch and fits any splatting pipeline: put it between the activated opacities and the
rasteriser. While no alpha is clamped the render of a random subset is an unbiased estimate of the full render. That of
a subset chosen by scores (`DropGaussian.scores`, for the paper's comparison) is not.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["DropGaussian", "drop_gaussian"]


def drop_gaussian(
    opacities: Tensor, p: float = 0.2, training: bool = True, generator: torch.Generator | None = None
) -> Tensor:
    """Set each opacity to 0 with probability p and multiply the others by 1/(1 - p).

    The semantics are those of `torch.nn.functional.dropout`, on activated opacities (never on logits: a logit of 0 is
    an opacity of 0.5). The result may exceed 1; it must not be clamped, the rasteriser clamps alpha for each pixel.

    Args:
        opacities: activated opacities of any shape; each element is drawn on its own. `(N,)` gives one mask for all
            cameras, `(C, N)` one a camera.
        p: the drop rate, in [0, 1).
        training: if False, the same tensor object comes back.
        generator: a generator on the device of `opacities`; None takes torch's default one.

    Returns:
        A tensor like `opacities`; the same object where nothing is to be dropped (p = 0 or not training).

    Raises:
        ValueError: p is outside [0, 1). The rate 1 is refused, other than in `nn.Dropout`: it would leave no image.

    Example:
        >>> _ = torch.manual_seed(0)
        >>> drop_gaussian(torch.full((4,), 0.8), p=0.2)
        tensor([1., 0., 1., 1.])
    """
    _check_rate("p", p)
    if not training or p == 0.0:
        return opacities
    if generator is None:
        return nn.functional.dropout(opacities, p, training=True)
    mask = torch.empty_like(opacities).bernoulli_(1.0 - p, generator=generator).div_(1.0 - p)
    return opacities * mask


def linear(progress: float) -> float:
    """The paper's schedule: the rate grows in proportion to the progress."""
    return progress


def constant(progress: float) -> float:
    """The same rate throughout."""
    return 1.0


SCHEDULES: dict[str, Callable[[float], float]] = {"linear": linear, "constant": constant}


class DropGaussian(nn.Module):
    """`drop_gaussian` as a layer: active in `train()`, the identity in `eval()`, as `nn.Dropout` is.

    The rate of a call is `p * schedule(progress)`. `progress` is a plain attribute in [0, 1] that the training loop
    sets; it defaults to 1, so that a layer whose progress is never set is plain dropout at p.

    `scores` is a plain attribute too, None unless set: a tensor of the shape of the opacities. With it nothing is
    random: the call drops the share of the rate with the highest scores, of each camera's row in `(C, N)`, and scales
    the rest by 1/(1 - rate) as ever. It stays until it is replaced; the layer does not know what the scores mean.

    Args:
        p: the final drop rate, in [0, 1). The paper uses 0.2 for every scene.
        schedule: "linear" (the paper's), "constant", or a function from progress in [0, 1] to a factor.
        seed: None draws from torch's default generator of the tensor's device, as `nn.Dropout` does. An integer gives
            the layer a stream of its own, kept through `.to`, deepcopy and pickle; such a layer must not run inside
            `torch.utils.checkpoint`, which restores only the default generators before it recomputes.

    Raises:
        ValueError: p or the resulting rate is outside [0, 1), or the schedule's name is unknown.

    Example:
        >>> drop = DropGaussian(p=0.2)
        >>> for step in range(1, 4):
        ...     drop.progress = step / 3
        ...     opacities = drop(torch.full((5,), 0.5))
        >>> drop.eval()(opacities) is opacities
        True
    """

    def __init__(
        self, p: float = 0.2, schedule: str | Callable[[float], float] = "linear", seed: int | None = None
    ) -> None:
        super().__init__()
        _check_rate("p", p)
        if isinstance(schedule, str) and schedule not in SCHEDULES:
            raise ValueError(f"schedule: expected one of {sorted(SCHEDULES)} or a callable, got {schedule!r}")
        if not isinstance(schedule, str) and not callable(schedule):
            raise ValueError(f"schedule: expected a name or a callable, got {schedule!r}")
        self.p = float(p)
        self.schedule = SCHEDULES[schedule] if isinstance(schedule, str) else schedule
        self.seed = seed
        self.scores: Tensor | None = None
        self._progress: float | None = None
        self._warned = False
        self._generator: torch.Generator | None = None

    @property
    def progress(self) -> float:
        """How much of the training is done, in [0, 1]; 1.0 until it is set."""
        return 1.0 if self._progress is None else self._progress

    @progress.setter
    def progress(self, value: float) -> None:
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"progress: expected a number in [0, 1], got {value}")
        self._progress = float(value)

    @property
    def rate(self) -> float:
        """The drop rate of the next call in `train()`."""
        rate = self.p * self.schedule(self.progress)
        _check_rate("p * schedule(progress)", rate)
        return rate

    def forward(self, opacities: Tensor) -> Tensor:
        """Drop and rescale in `train()`, return `opacities` itself in `eval()`. See :func:`drop_gaussian`.

        Raises:
            ValueError: `scores` is set and has another shape than `opacities`.
        """
        if not self.training:
            return opacities
        if self._progress is None and not self._warned and self.schedule is not constant:
            self._warned = True
            warnings.warn(
                f"DropGaussian: progress was never set, so the schedule has no effect and the rate is {self.rate:g} "
                "throughout; set `drop.progress = step / total_steps` in the loop, or schedule='constant'",
                stacklevel=2,
            )
        if self.scores is not None:
            return _drop_highest(opacities, self.scores, self.rate)
        generator = None if self.seed is None else self._own_generator(opacities.device)
        return drop_gaussian(opacities, self.rate, True, generator)

    def get_rng_state(self) -> Tensor:
        """The state of the layer's own generator, for a checkpoint.

        Raises:
            ValueError: the layer has no generator of its own (seed is None).
        """
        if self.seed is None:
            raise ValueError("seed: expected an integer to have a state of one's own, got None")
        device = torch.device("cpu") if self._generator is None else self._generator.device
        return self._own_generator(device).get_state()

    def set_rng_state(self, state: Tensor, device: torch.device | str = "cpu") -> None:
        """Continue the stream that `get_rng_state` saw, on the device where the opacities will be."""
        if self.seed is None:
            raise ValueError("seed: expected an integer to have a state of one's own, got None")
        self._own_generator(torch.device(device)).set_state(state)

    def extra_repr(self) -> str:
        """What `print` shows."""
        name = getattr(self.schedule, "__name__", repr(self.schedule))
        progress = "1.0 (never set)" if self._progress is None else f"{self._progress:g}"
        seed = "" if self.seed is None else f", seed={self.seed}"
        return f"p={self.p:g}, schedule={name}, progress={progress}{seed}"

    def _own_generator(self, device: torch.device) -> torch.Generator:
        if self._generator is None or self._generator.device != device:
            self._generator = torch.Generator(device).manual_seed(self.seed or 0)
        return self._generator

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        if self._generator is not None:
            state["_generator"] = (str(self._generator.device), self._generator.get_state())
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if isinstance(state["_generator"], tuple):
            device, generator_state = state["_generator"]
            self._generator = torch.Generator(device)
            self._generator.set_state(generator_state)


def _drop_highest(opacities: Tensor, scores: Tensor, rate: float) -> Tensor:
    """Without randomness: the round(rate N) highest scores go; of equal ones the first."""
    if scores.shape != opacities.shape:
        raise ValueError(f"scores: expected shape {tuple(opacities.shape)}, got {tuple(scores.shape)}")
    if rate == 0.0:
        return opacities
    rows = scores.reshape(-1, scores.shape[-1]) if scores.ndim > 1 and scores.shape[-1] > 1 else scores.reshape(1, -1)
    dropped = rows.argsort(dim=1, descending=True, stable=True)[:, : round(rate * rows.shape[1])]
    mask = torch.full_like(rows, 1.0 / (1.0 - rate), dtype=opacities.dtype).scatter_(1, dropped, 0.0)
    return opacities * mask.reshape(opacities.shape)


def _check_rate(name: str, rate: float) -> None:
    if not 0.0 <= rate < 1.0:
        raise ValueError(f"{name}: expected a rate in [0, 1), got {rate}")
