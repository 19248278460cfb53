"""DropGaussian: drop Gaussians at random in training and scale up the opacities of the rest.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: o_i <- M_i o_i with M_i = 1/(1 - r) for kept and 0 for dropped Gaussians, r_t = gamma t / T.

This file needs only torch and can be copied into any splatting pipeline. The layer belongs between the activated
opacities and the rasteriser. While no alpha is clamped, the mean render over all masks is the full render.
"""

import contextlib
import warnings
from collections.abc import Callable
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor, nn

_CALLER = 6  # stack level of the line `layer(opacities)`: nn.Module.__call__ takes two levels


def drop_gaussian(
    opacities: Tensor, p: float = 0.2, training: bool = True, generator: torch.Generator | None = None
) -> Tensor:
    """Set each opacity to 0 with probability p and multiply the others by 1/(1 - p).

    This is `torch.nn.functional.dropout` of activated opacities (never of logits: a logit of 0 is an opacity of 0.5).
    The result may exceed 1; it must not be clamped, the rasteriser clamps alpha for each pixel.

    Args:
        opacities: of any shape and floating point dtype; elements are drawn independently. `(N,)` gives one mask for
            all cameras, `(C, N)` one per camera.
        p: the drop rate, in [0, 1).
        training: if False, nothing is dropped.
        generator: draws the mask on its own device, whatever that of `opacities`; None uses torch's default one.

    Returns:
        A tensor like `opacities`; the same object if nothing is dropped (p = 0 or not training).

    Raises:
        TypeError: `opacities` is not a floating point tensor.
        ValueError: p is outside [0, 1). Unlike `nn.Dropout`, p = 1 is refused: it would leave an empty image.

    Examples:
        >>> drop_gaussian(torch.full((100,), 0.8), p=0.2).unique()
        tensor([0., 1.])
    """
    p = _fraction("p", p)
    if not training or p == 0.0:
        return opacities
    if not isinstance(opacities, Tensor) or not opacities.is_floating_point():
        raise TypeError(f"opacities: expected a floating point tensor, got {getattr(opacities, 'dtype', opacities)!r}")
    if generator is None:
        return nn.functional.dropout(opacities, p, training=True)
    mask = torch.empty_like(opacities, device=generator.device)
    mask.bernoulli_(1.0 - p, generator=generator).div_(1.0 - p)
    return opacities * mask.to(opacities.device)


class DropGaussian(nn.Module):
    """`drop_gaussian` as a layer: active in `train()`, the identity in `eval()`, as `nn.Dropout` is.

    The rate of a call is `p * schedule(progress)`. The training loop sets `progress`, in [0, 1]; a layer whose progress
    is never set is plain dropout at p. The first call in `train()` warns about that, and about opacities outside
    [0, 1], which are probably logits. The `state_dict` is empty. `torch.compile` runs the layer as it is, outside its
    graphs: a rising rate would otherwise be recompiled in each step.

    Args:
        p: the final drop rate, in [0, 1). The paper uses 0.2 for every scene.
        schedule: "linear" (the paper's), "constant", or a function from progress in [0, 1] to a factor.
        seed: None draws from torch's default generator of the tensor's device, as `nn.Dropout` does. An integer gives
            the layer a stream of its own, which pickle and deepcopy continue in the copy. With
            `DistributedDataParallel` give each rank its own seed. Such a layer must not run inside
            `torch.utils.checkpoint`, which restores only the default generators.
        device: where that stream draws. On the CPU it draws the same wherever the opacities are, and masks are copied
            to them; on their own device nothing is copied.

    Raises:
        ValueError: p or the rate is outside [0, 1), the schedule is unknown, or the seed not from -2^63 to 2^64 - 1.

    Examples:
        >>> drop = DropGaussian(p=0.2)
        >>> drop.progress = 1 / 3  # step / total_steps, in a training loop
        >>> opacities = drop(torch.full((5,), 0.5))
        >>> drop.eval()(opacities) is opacities
        True
    """

    def __init__(
        self,
        p: float = 0.2,
        schedule: str | Callable[[float], float] = "linear",
        seed: int | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__()
        if schedule not in ("linear", "constant") and not callable(schedule):
            raise ValueError(f"schedule: expected 'linear', 'constant' or a callable, got {schedule!r}")
        if seed is not None and not _is_seed(seed):
            raise ValueError(f"seed: expected None or an integer from -2^63 to 2^64 - 1, got {seed!r}")
        self.p = _fraction("p", p)
        self.schedule = schedule
        self.seed = seed
        self._generator = None if seed is None else torch.Generator(device).manual_seed(int(seed))
        self._progress: float | None = None
        self._was_called = False

    @property
    def progress(self) -> float:
        """The fraction of the training that is done, in [0, 1]; 1.0 until it is set."""
        return 1.0 if self._progress is None else self._progress

    @progress.setter
    def progress(self, value: float) -> None:
        self._progress = _fraction("progress", value, closed=True)

    @property
    def rate(self) -> float:
        """The drop rate of the next call in `train()`."""
        if callable(self.schedule):
            factor = self.schedule(self.progress)
        else:
            factor = self.progress if self.schedule == "linear" else 1.0
        return _fraction("p * schedule(progress)", self.p * factor)

    def forward(self, opacities: Tensor) -> Tensor:
        """Drop and rescale in `train()`, return `opacities` itself in `eval()`. See :func:`drop_gaussian`."""
        if not self.training:
            return opacities
        if torch.compiler.is_compiling():
            dropped: Tensor = torch.compiler.disable(self._drop)(opacities)
            return dropped
        return self._drop(opacities)

    def _drop(self, opacities: Tensor) -> Tensor:
        dropped = drop_gaussian(opacities, self.rate, generator=self._generator)
        if not self._was_called:
            self._was_called = True
            self._warn_of_mistakes(opacities)
        return dropped

    def _warn_of_mistakes(self, opacities: Tensor) -> None:
        if self._progress is None and self.schedule != "constant":
            advice = "set `drop.progress = step / total_steps` in the loop, or schedule='constant'"
            message = f"progress was never set, so the rate stays at {self.rate:g}; {advice}"
            warnings.warn(f"DropGaussian: {message}", stacklevel=_CALLER)
        with contextlib.suppress(RuntimeError):  # in vmap and on the meta device there are no values to read
            if bool(((opacities < 0) | (opacities > 1)).any()):
                message = "expected opacities in [0, 1]; the layer belongs behind their activation, not on logits"
                warnings.warn(f"DropGaussian: {message}", stacklevel=_CALLER)

    def get_rng_state(self) -> Tensor:
        """The state of the layer's own stream, a tensor on the CPU; a ValueError where it has none (seed is None)."""
        return self._own_generator().get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Restore a state that `get_rng_state` of a layer with a stream on the same kind of device returned."""
        self._own_generator().set_state(state.cpu())

    def _own_generator(self) -> torch.Generator:
        if self._generator is None:
            raise ValueError("seed: expected an integer, got None: the layer then has no state of its own")
        return self._generator

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        if self._generator is not None:  # as bytes: neither generators nor temporary tensors reach a spawned process
            state["_generator"] = (self._generator.device, bytes(self._generator.get_state().tolist()))
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        if self._generator is not None:
            device, rng_state = state["_generator"]
            self._generator = torch.Generator(device)
            self._generator.set_state(torch.frombuffer(bytearray(rng_state), dtype=torch.uint8))

    def extra_repr(self) -> str:
        """The settings, as `print` displays them."""
        name = getattr(self.schedule, "__name__", self.schedule)
        progress = "1.0 (never set)" if self._progress is None else f"{self._progress:g}"
        seed = "" if self.seed is None else f", seed={self.seed}"
        return f"p={self.p:g}, schedule={name}, progress={progress}{seed}"


def _is_seed(value: Any) -> bool:
    """Whether `torch.Generator.manual_seed` takes a value; True and False are no seeds."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        return False
    return -(2**63) <= int(value) < 2**64


def _fraction(name: str, value: Any, closed: bool = False) -> float:
    """The value as a float; a ValueError if it is no number in [0, 1), or in [0, 1] where `closed`."""
    number = float(value) if isinstance(value, Real | Tensor) else -1.0
    if not (0.0 <= number < 1.0 or (closed and number == 1.0)):
        raise ValueError(f"{name}: expected a number in [0, 1{']' if closed else ')'}, got {value!r}")
    return number
