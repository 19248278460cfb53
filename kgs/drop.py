"""DropGaussian: drop Gaussians at random in training and scale up the opacities of the rest.

Source: H. Park, G. Ryu, W. Kim, "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting",
CVPR 2025: o_i <- M_i o_i with M_i = 1/(1 - r) for kept and 0 for dropped Gaussians, r_t = gamma t / T.

The layer needs only torch and fits any splatting pipeline: put it between the activated opacities and the
rasteriser. While no alpha is clamped the render of a random subset is an unbiased estimate of the full render.
"""

import contextlib
import warnings
from collections.abc import Callable
from numbers import Integral, Real
from typing import Any, Self

import torch
from torch import Tensor, nn

SCHEDULES = ("constant", "linear")


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
    mask = torch.empty_like(opacities, device=generator.device).bernoulli_(1.0 - p, generator=generator).div_(1.0 - p)
    return opacities * mask.to(opacities.device)


class DropGaussian(nn.Module):
    """`drop_gaussian` as a layer: active in `train()`, the identity in `eval()`, as `nn.Dropout` is.

    The rate of a call is `p * schedule(progress)`. The training loop sets `progress`, in [0, 1]; a layer whose progress
    is never set is plain dropout at p, and warns once. It also warns once if it gets opacities outside [0, 1] on the
    CPU, which are probably logits. The `state_dict` is empty, whatever is assigned to the layer.

    Args:
        p: the final drop rate, in [0, 1). The paper uses 0.2 for every scene.
        schedule: "linear" (the paper's), "constant", or a function from progress in [0, 1] to a factor.
        seed: None draws from torch's default generator of the tensor's device, as `nn.Dropout` does. An integer gives
            the layer a stream of its own, kept through `.to`, deepcopy and pickle. Replicas of `nn.DataParallel` draw
            from it; with `DistributedDataParallel` give each rank its own seed. Such a layer must not run inside
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
        if not (schedule in SCHEDULES if isinstance(schedule, str) else callable(schedule)):
            raise ValueError(f"schedule: expected one of {list(SCHEDULES)} or a callable, got {schedule!r}")
        is_integer = isinstance(seed, (int, Integral)) and not isinstance(seed, bool)
        if seed is not None and not (is_integer and -(2**63) <= seed < 2**64):
            raise ValueError(f"seed: expected None or an integer from -2^63 to 2^64 - 1, got {seed!r}")
        self.p = _fraction("p", p)
        self.schedule = schedule
        self.seed = seed
        self._progress: float | None = None
        # mutable objects, which shallow copies such as the replicas of nn.DataParallel share and advance
        self._warned: set[str] = set()
        self._stream = None if seed is None else torch.Generator(device).manual_seed(int(seed))

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
        factors = {"linear": self.progress, "constant": 1.0}
        factor = factors[self.schedule] if isinstance(self.schedule, str) else self.schedule(self.progress)
        return _fraction("p * schedule(progress)", self.p * factor)

    def forward(self, opacities: Tensor) -> Tensor:
        """Drop and rescale in `train()`, return `opacities` itself in `eval()`. See :func:`drop_gaussian`."""
        if not self.training:
            return opacities
        if self._progress is None and self.schedule != "constant":
            wanted = "set `drop.progress = step / total_steps` in the loop, or schedule='constant'"
            self._warn_once("progress", f"progress was never set, so the rate is {self.rate:g} throughout; {wanted}")
        dropped = drop_gaussian(opacities, self.rate, True, self._stream)
        if opacities.device.type == "cpu" and not torch.compiler.is_compiling():
            with contextlib.suppress(RuntimeError, IndexError):  # an empty tensor, or inside vmap
                low, high = opacities.detach().aminmax()
                if low < 0 or high > 1:
                    wanted = "expected opacities in [0, 1]; the layer belongs behind their activation, not on logits"
                    self._warn_once("values", f"{wanted}, got {low:.3g} to {high:.3g}")
        return dropped

    def get_rng_state(self) -> Tensor:
        """The state of the layer's own stream, a tensor on the CPU; a ValueError where it has none (seed is None)."""
        return self._own_stream().get_state()

    def set_rng_state(self, state: Tensor) -> None:
        """Restore a state that `get_rng_state` of a layer with a stream on the same kind of device returned."""
        self._own_stream().set_state(state.cpu())

    def extra_repr(self) -> str:
        """What `print` shows."""
        name = getattr(self.schedule, "__name__", self.schedule)
        progress = "1.0 (never set)" if self._progress is None else f"{self._progress:g}"
        seed = "" if self.seed is None else f", seed={self.seed}"
        return f"p={self.p:g}, schedule={name}, progress={progress}{seed}"

    def _own_stream(self) -> torch.Generator:
        if self._stream is None:
            raise ValueError("seed: expected an integer, got None: the layer then has no state of its own")
        return self._stream

    def _warn_once(self, kind: str, message: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            warnings.warn(f"DropGaussian: {message}", stacklevel=3)

    def _replicate_for_data_parallel(self) -> Self:
        replica: Self = super()._replicate_for_data_parallel()
        if self._stream is not None and self.training:  # in order here; the replicas' threads would race for one stream
            device = self._stream.device
            seed = int(torch.randint(2**62, (), generator=self._stream, device=device))
            replica._stream = torch.Generator(device).manual_seed(seed)
        return replica

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value.detach() if isinstance(value, Tensor) else value)


def _fraction(name: str, value: Any, closed: bool = False) -> float:
    """A number in [0, 1), or in [0, 1]."""
    number = float(value) if isinstance(value, (Real, Tensor)) else -1.0
    if not (0.0 <= number < 1.0 or (closed and number == 1.0)):
        raise ValueError(f"{name}: expected a number in [0, 1{']' if closed else ')'}, got {value!r}")
    return number
