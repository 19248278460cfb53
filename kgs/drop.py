"""DropGaussian: drop Gaussians at random in training and scale up the opacities of the rest.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: o_i <- M_i o_i with M_i = 1/(1 - r) for kept and 0 for dropped Gaussians, r_t = gamma t / T.

This file needs only torch and can be copied into any splatting pipeline. The layer belongs between the activated
opacities and the rasteriser. While no alpha is clamped, the mean render over all masks is the full render.
"""

import contextlib
import inspect
import pickle
import warnings
from collections.abc import Callable
from numbers import Real
from typing import Any

import torch
from torch import Generator, Tensor, nn

_is_wrapped = getattr(torch._C._functorch, "is_functorch_wrapped_tensor", lambda _: False)  # by vmap, grad, ...


def drop_gaussian(
    opacities: Tensor,
    p: float | Tensor = 0.2,
    training: bool = True,
    generator: Generator | None = None,
    scale: bool = True,
) -> Tensor:
    """Set each opacity to 0 with probability p and multiply the others by 1/(1 - p).

    This is `torch.nn.functional.dropout` of activated opacities, never logits. It may exceed 1: do not clamp it.

    Args:
        opacities: floating point, `(N,)` or `(N, 1)` for all cameras, `(C, N)` to drop others in each, or any shape.
        p: the drop rate, in [0, 1); a tensor of several has one for each Gaussian, `(N,)`, or opacity. No gradient.
        training: if False, nothing is dropped.
        generator: draws the mask on its own device, whatever that of `opacities`; None uses torch's default one.
        scale: if False, the others keep their values, so that the mean over all masks is 1 - p times the opacity.

    Returns:
        A tensor like `opacities`; the same object if nothing is dropped (p is the number 0, or not training).

    Raises:
        TypeError: `opacities` is not a floating point tensor.
        ValueError: p is outside [0, 1), or of another shape; p = 1, which `nn.Dropout` takes, leaves an empty image.
    """
    rate = _fraction("p", p)
    return _dropped(opacities, rate, generator, scale)[0] if training else opacities


class DropGaussian(nn.Module):
    """`drop_gaussian` as a layer: active in `train()`, the identity in `eval()`, as `nn.Dropout` is.

    The rate of a call is `p * schedule(progress)`. The training loop sets `progress`, in [0, 1]; a layer whose progress
    is never set is plain dropout at p. The first call in `train()` warns about that, and about opacities outside
    [0, 1], which are probably logits. The `state_dict` is empty. `torch.compile` runs the layer outside its
    graphs, so `fullgraph=True` raises in `train()`.

    Args:
        p: as in :func:`drop_gaussian`, at the end of the schedule. The attribute may be set anew.
        schedule: "linear" (the paper's), "constant", or a function from progress in [0, 1] to a factor.
        seed: None draws from torch's default generator, as `nn.Dropout` does. An integer gives the layer a stream of
            its own, which copies continue: give each rank another seed. Do not use a seed within
            `torch.utils.checkpoint`, which would draw another mask when it computes again.
        device: where that stream draws. The default, the CPU, gives the same masks on every device, and copies N
            numbers to it in each call.
        scale: as in :func:`drop_gaussian`.

    Raises:
        ValueError: p or the rate is outside [0, 1), the schedule is unknown, or the seed not from -2^63 to 2^64 - 1.
    """

    __call__: Callable[..., Tensor]  # for type checkers, to which torch's says Any

    def __init__(
        self,
        p: float | Tensor = 0.2,
        schedule: str | Callable[[float], float] = "linear",
        seed: int | None = None,
        device: torch.device | str = "cpu",
        scale: bool = True,
    ) -> None:
        super().__init__()
        if schedule not in ("linear", "constant") and not callable(schedule):
            raise ValueError(f"schedule: expected 'linear', 'constant' or a callable, got {schedule!r}")
        is_whole = hasattr(seed, "__index__") and not isinstance(seed, bool | Tensor)
        if seed is not None and not (is_whole and -(2**63) <= int(seed) < 2**64):
            raise ValueError(f"seed: expected None or an integer from -2^63 to 2^64 - 1, got {seed!r}")
        self.p = _fraction("p", p)
        self.schedule = schedule
        self.seed = seed
        self.scale = scale
        self._last_scale: Tensor | None = None
        self._generator = None if seed is None else Generator(device).manual_seed(int(seed))
        self._progress: float | None = None
        self._was_called = False

    @property
    def progress(self) -> float:
        """The fraction of the training that is done, in [0, 1] but for rounding above 1; 1.0 until it is set."""
        return 1.0 if self._progress is None else self._progress

    @progress.setter
    def progress(self, value: float) -> None:
        self._progress = float(_fraction("progress", value, closed=True))

    @property
    def rate(self) -> float | Tensor:
        """The drop rate of the next call in `train()`, or the rates."""
        factor = self.progress if self.schedule == "linear" else 1.0
        if callable(self.schedule):
            factor = self.schedule(self.progress)
            if torch.Size(getattr(factor, "shape", ())).numel() != 1:
                raise ValueError(f"schedule: expected a function that returns a number, got {factor!r:.80}")
        return _fraction("p * schedule(progress)", self.p * (0.0 if -1e-6 <= factor < 0.0 else factor))

    @property
    def last_scale(self) -> Tensor | None:
        """What the last call in `train()` multiplied each opacity by, in their shape, detached.

        None before the first such call, in `eval()`, in a copy of the layer, and after a call within `torch.func`.
        """
        return self._last_scale if self.training else None

    def forward(self, opacities: Tensor) -> Tensor:
        """Drop and rescale in `train()`, return `opacities` itself in `eval()`. See :func:`drop_gaussian`."""
        if not self.training:
            return opacities
        return torch.compiler.disable(self._drop)(opacities) if torch.compiler.is_compiling() else self._drop(opacities)

    def _drop(self, opacities: Tensor) -> Tensor:
        dropped, factors = _dropped(opacities, self.rate, self._generator, self.scale)
        self._last_scale = None if _is_wrapped(factors) else factors
        if not self._was_called:
            self._was_called = True
            if self._progress is None and self.schedule != "constant":
                _warn("progress was never set; set `drop.progress = step / steps`, or schedule='constant'")
            with contextlib.suppress(RuntimeError):  # in vmap and on the meta device there are no values to read
                if bool(((opacities < 0) | (opacities > 1)).any()):
                    _warn("expected opacities in [0, 1]; the layer belongs behind their activation, not on logits")
        return dropped

    def get_rng_state(self) -> Tensor:
        """The state of the layer's own stream, a tensor on the CPU; a ValueError where it has none (seed is None)."""
        return self._own_generator().get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Restore a state that `get_rng_state` of a layer with a stream on the same kind of device returned."""
        self._own_generator().set_state(state.cpu())

    def _own_generator(self) -> Generator:
        if self._generator is None:
            raise ValueError("seed: expected an integer, got None: the layer then has no state of its own")
        return self._generator

    def __getstate__(self) -> dict[str, Any]:
        # pickled to bytes: neither generators nor temporary tensors reach a spawned process
        return self.__dict__ | {"_generator": pickle.dumps(self._generator), "_last_scale": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state | {"_generator": pickle.loads(state["_generator"])})

    def extra_repr(self) -> str:
        """The settings, as `print` displays them."""
        p = f"tensor of shape {tuple(self.p.shape)}" if isinstance(self.p, Tensor) else f"{self.p:g}"
        name = getattr(self.schedule, "__name__", self.schedule)
        progress = "1.0 (never set)" if self._progress is None else f"{self._progress:g}"
        progress = "" if self.schedule == "constant" else f", progress={progress}"
        seed = "" if self.seed is None else f", seed={self.seed}"
        return f"p={p}, schedule={name}{progress}{seed}" + ("" if self.scale else ", scale=False")


def _dropped(x: Tensor, rate: float | Tensor, generator: Generator | None, scale: bool) -> tuple[Tensor, Tensor]:
    """The opacities after dropping, and the factors of them that do it."""
    if not isinstance(x, Tensor) or not x.is_floating_point():
        raise TypeError(f"opacities: expected a floating point tensor, got {getattr(x, 'dtype', x)!r}")
    if isinstance(rate, Tensor):
        rate = rate[..., None] if x.shape == (*rate.shape, 1) else rate
        if rate.shape not in (x.shape, x.shape[-1:]):
            raise ValueError(f"p: expected a rate for each of {tuple(x.shape)} opacities, got {tuple(rate.shape)}")
        dtype = torch.promote_types(torch.promote_types(rate.dtype, x.dtype), torch.float32)
        kept = (1 - rate.to(generator.device if generator else x.device, dtype)).expand(x.shape)
        factors = torch.bernoulli(kept, generator=generator) / kept
    elif rate == 0.0:
        return x, torch.ones_like(x)
    elif generator is None:
        factors = nn.functional.dropout(torch.ones_like(x), rate)
    else:
        factors = torch.empty_like(x, device=generator.device)
        factors.bernoulli_(1.0 - rate, generator=generator).div_(1.0 - rate)
    factors = (factors if scale else factors > 0).to(x)
    return x * factors, factors


def _warn(message: str) -> None:
    """Warn at the line that called the layer: not in this file, torch or kgs. As kgs' own `warn`, without kgs."""
    names = [call.frame.f_globals.get("__name__", "") for call in inspect.stack(context=0)]
    outside = [not f"{name}.".startswith(("torch.", "kgs.", f"{__name__}.")) for name in [*names, ""]]
    warnings.warn(f"DropGaussian: {message}", stacklevel=outside.index(True) + 1)


def _fraction(name: str, value: Any, closed: bool = False) -> float | Tensor:
    """A float, or a tensor of several; ValueError unless in [0, 1), or where `closed` in [0, 1] but for rounding."""
    many = isinstance(value, Tensor) and value.numel() != 1
    if many and not closed and bool(((value >= 0) & (value < 1)).all()):
        return torch.detach(value)
    number = float(value) if isinstance(value, Real | Tensor) and not many else -1.0
    if not (0.0 <= number < 1.0 or (closed and 1.0 <= number <= 1.0 + 1e-6)):
        raise ValueError(f"{name}: expected a number in [0, 1{']' if closed else ')'}, got {value!r}")
    return min(number, 1.0)
