"""Adaptive density control: clone, split and prune Gaussians while they are being fitted, and reset opacities.

Source: B. Kerbl et al., "3D Gaussian Splatting", SIGGRAPH 2023, section 5.2, with the numbers of the DropGaussian
recipe (threshold 5e-4, pruning by opacity alone). The number of Gaussians in a fit changes only here.
"""

import math
from collections import defaultdict
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.graph import increment_version

from kgs._support.checks import check_kind
from kgs._support.errors import ArgumentError

from .backends import Backend, get_backend
from .geometry.covariance import rotation_matrices
from .geometry.types import ProjectedGaussians
from .model import GaussianModel

CHILDREN = 2
SHRINK = 1.6  # a child's scale is its parent's divided by 0.8 times the number of children
_UNSUPPORTED_OPTIMIZERS = (torch.optim.LBFGS, torch.optim.Adafactor, torch.optim.Rprop)


class Optimizer(Protocol):
    """What a densifier needs of an optimizer: two attributes of :class:`torch.optim.Optimizer`."""

    param_groups: list[dict[str, Any]]
    state: defaultdict[Tensor, Any]


@dataclass(frozen=True)
class DensifyReport:
    """What one densification did, in Gaussians.

    Args:
        cloned: how many were copied.
        split: how many were replaced by two smaller ones.
        pruned: how many were removed because their opacity is too low.
        total: how many there are now: those before + cloned + split - pruned.
        capped: how many above the threshold were not cloned or split because of `max_gaussians`.
    """

    cloned: int
    split: int
    pruned: int
    total: int
    capped: int


class Densifier:
    """Adds Gaussians where the loss gradient is large and removes transparent ones, together with their Adam state.

    The statistic is the norm of the loss gradient by the projected centre in normalised device coordinates (pixels over
    half the width and height), averaged over the renders since the last `step` in which a Gaussian was visible. A
    dropped Gaussian counts as visible with gradient 0, as in the method's release.

    Convention:
        The loss is a mean over cameras; the gradients are multiplied by their number C, so that the threshold means the
        same for any C.

    Args:
        model: the Gaussians.
        optimizer: ONE optimizer that holds each of :meth:`GaussianModel.per_gaussian` (gsplat's dict of optimizers
            becomes one Adam with a group for each); other parameters of model and optimizer stay as they are. Its
            state for a parameter consists of scalars and of tensors of that parameter's shape which start at 0: Adam,
            SGD, RMSprop; not LBFGS or Adafactor.
        extent: size of the camera rig in world units, > 0, see :func:`camera_extent`.
        grad_threshold: mean gradient from which a Gaussian is cloned or split, >= 0.
        absgrad: take the absolute gradients that renders with `RasterOptions.absgrad` leave; they are about four times
            as large.
        percent_dense: up to this fraction of the extent (largest scale) a Gaussian is cloned, above it split, > 0.
        prune_opacity: Gaussians below this opacity are removed, in [0, 1].
        max_gaussians: upper bound for the count; Gaussians with the largest gradients come first. None: no limit.
        generator: draws the positions of split Gaussians; None makes a generator seeded with 0.
        backend: "torch", "auto", "numba" or "triton": Triton has kernels for the statistics of renders of one camera,
            and for `decay_opacity`.

    Raises:
        TypeError: `model` is not a GaussianModel.
        ValueError: a number is out of range, or the optimizer does not hold the model's parameters or holds state of
            another shape (also raised by `step` and `reset_opacity`, which then change nothing), or the backend does
            not exist or does not cover the model.
        ModuleNotFoundError: the backend is numba or triton, and it is not installed.

    Examples:
        >>> model = GaussianModel.from_points(torch.rand(20, 3), torch.rand(20, 3))
        >>> densifier = Densifier(model, torch.optim.Adam(model.parameters()), extent=1.0)
        >>> densifier.step()
        DensifyReport(cloned=0, split=0, pruned=0, total=20, capped=0)
    """

    def __init__(
        self,
        model: GaussianModel,
        optimizer: Optimizer,
        extent: float,
        *,
        grad_threshold: float = 5e-4,
        absgrad: bool = False,
        percent_dense: float = 0.01,
        prune_opacity: float = 0.005,
        max_gaussians: int | None = None,
        generator: torch.Generator | None = None,
        backend: str | Backend = "torch",
    ) -> None:
        check_kind("model", model, GaussianModel)
        maximum = 1 if max_gaussians is None else max_gaussians
        for name, number, fits, expected in (
            ("extent", extent, 0.0 < extent < math.inf, "a finite number > 0"),
            ("percent_dense", percent_dense, 0.0 < percent_dense < math.inf, "a finite number > 0"),
            ("grad_threshold", grad_threshold, grad_threshold >= 0.0, "a number >= 0"),
            ("prune_opacity", prune_opacity, 0.0 <= prune_opacity <= 1.0, "a number in [0, 1]"),
            ("max_gaussians", max_gaussians, maximum >= 1 and maximum % 1 == 0, "an integer >= 1 or None"),
        ):
            if not fits:
                raise ArgumentError(name, expected, number)
        if not hasattr(optimizer, "param_groups"):
            raise TypeError(f"optimizer: expected one torch.optim.Optimizer, got {type(optimizer).__name__}")
        if isinstance(optimizer, _UNSUPPORTED_OPTIMIZERS):
            raise ArgumentError("optimizer", "Adam, SGD or the like", type(optimizer).__name__)
        self.model = model
        self.optimizer = optimizer
        self.extent = float(extent)
        self.grad_threshold = grad_threshold
        self.absgrad = absgrad
        self.percent_dense = percent_dense
        self.prune_opacity = prune_opacity
        self.max_gaussians = max_gaussians
        self.generator = torch.Generator().manual_seed(0) if generator is None else generator
        self._backend = get_backend(backend, model.means.device).covering("optimizer", model.means)
        self._restart_statistics(torch.zeros_like(self.model.means[:, 0]))
        self._check()

    @property
    def mean_gradients(self) -> Tensor:
        """The mean since the last `step`, `(N,)`; the value before, or the parent's, counts as one observation."""
        sums, counts, last = self._statistics.values()
        return (last + sums) / (1 + counts)

    @torch.no_grad()
    def observe(self, projected: ProjectedGaussians) -> None:
        """Add the gradients of one render to the statistics; each pair (camera, Gaussian) counts once.

        Call `projected.means2d.retain_grad()` between the render and `backward`, and this after `backward`. With
        `absgrad` there is nothing to retain.

        Raises:
            TypeError: `projected` is something else, as a whole `Rendering`.
            ValueError: `projected.means2d` has no gradient, or the number of Gaussians differs from the model's.

        Examples:
            >>> import kgs
            >>> model = GaussianModel.from_points(torch.rand(20, 3) + 1, torch.rand(20, 3))
            >>> optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
            >>> densifier = Densifier(model, optimizer, extent=1.0)
            >>> k = torch.tensor([[20.0, 0.0, 15.5], [0.0, 20.0, 11.5], [0.0, 0.0, 1.0]])
            >>> camera = kgs.pinhole_cameras(torch.eye(4), k, width=32, height=24)
            >>> out = kgs.GaussianRenderer()(model(), camera)
            >>> out.projected.means2d.retain_grad()
            >>> out.image.square().mean().backward()
            >>> densifier.observe(out.projected)
            >>> optimizer.step()
        """
        check_kind("projected", projected, ProjectedGaussians)
        self._check_count()
        count = projected.num_gaussians
        expected = len(self.model)
        if count != expected:
            raise ArgumentError("projected", f"a render of the model's {expected} Gaussians", f"one of {count}")
        if len(projected) == 0:
            return
        gradient = self._gradient_of(projected.means2d)
        height, width = projected.image_size
        ids = projected.gaussian_ids
        sums = self._statistics["gradient_sums"]
        counts = self._statistics["counts"]
        if self._backend.add_gradient_norms is not None and projected.num_cameras == 1:
            self._backend.add_gradient_norms(sums, counts, ids, gradient, (width / 2, height / 2))
            return
        norms = torch.hypot(gradient[:, 0] * (width / 2), gradient[:, 1] * (height / 2)) * projected.num_cameras
        sums.index_add_(0, ids, norms)
        counts.index_add_(0, ids, torch.ones_like(ids))

    @torch.no_grad()
    def step(self) -> DensifyReport:
        """Clone, split and prune by the statistics since the last step, and restart them.

        New Gaussians have zero Adam moments, the others keep theirs bit for bit. The parameters become new objects,
        without `.grad`, in the model and the optimizer: call it between `optimizer.step` and the next render.
        """
        self._check()
        model = self.model
        count_before = len(model)
        average = self._statistics["gradient_sums"] / self._statistics["counts"].clamp(min=1)
        opaque = ~(model.opacity_logits.sigmoid() < self.prune_opacity)  # NaN is not pruned: the trainer reports it
        over = (average >= self.grad_threshold) & opaque
        wanted = int(over.sum())
        room = wanted if self.max_gaussians is None else max(0, self.max_gaussians - int(opaque.sum()))
        if wanted > room:  # clone and split add one each; take the largest gradients
            order = torch.where(over, average, -1.0).argsort(descending=True, stable=True)
            over = torch.zeros_like(over).index_fill(0, order[:room], True)
        large = model.log_scales.exp().amax(dim=1) > self.percent_dense * self.extent
        cloned = (over & ~large).nonzero()[:, 0]
        split = (over & large).nonzero()[:, 0]
        unchanged = (opaque & ~(over & large)).nonzero()[:, 0]
        added = torch.cat([cloned, split.repeat(CHILDREN)])
        new = {name: parameter.index_select(0, added) for name, parameter in model.per_gaussian().items()}
        new["means"][len(cloned) :] += self._sample_offsets(split.repeat(CHILDREN))
        new["log_scales"][len(cloned) :] -= math.log(SHRINK)
        for name, parameter in model.per_gaussian().items():
            self._replace(name, torch.cat([parameter.index_select(0, unchanged), new[name]]), unchanged)
        self._restart_statistics(self.mean_gradients[torch.cat([unchanged, added])])
        return DensifyReport(
            cloned=len(cloned),
            split=len(split),
            pruned=count_before - len(unchanged) - len(split),
            total=len(model),
            capped=max(0, wanted - room),
        )

    @torch.no_grad()
    def add(self, gaussians: GaussianModel) -> None:
        """Append the Gaussians of another model, with zero Adam moments and no gradients observed.

        The parameters become new objects, as in `step`.

        Raises:
            TypeError: `gaussians` is not a GaussianModel.
            ValueError: it has harmonics of another degree, or more Gaussians than `max_gaussians` leaves room for.
        """
        check_kind("gaussians", gaussians, GaussianModel)
        self._check()
        model = self.model
        if gaussians.max_sh_degree != model.max_sh_degree:
            raise ArgumentError("gaussians", f"harmonics of degree {model.max_sh_degree}", gaussians.max_sh_degree)
        if self.max_gaussians is not None and len(gaussians) > (room := max(0, self.max_gaussians - len(model))):
            raise ArgumentError("gaussians", f"at most the {room} that max_gaussians leaves room for", len(gaussians))
        old_rows = torch.arange(len(model), device=model.means.device)
        for name, parameter in model.per_gaussian().items():
            added = gaussians.get_parameter(name).to(parameter)
            self._replace(name, torch.cat([parameter, added]), old_rows)
        for name, value in self._statistics.items():
            self._statistics[name] = torch.cat([value, value.new_zeros(len(gaussians))])

    @torch.no_grad()
    def reset_opacity(self, ceiling: float = 0.01) -> None:
        """Lower all opacities to at most `ceiling`, in (0, 1) (else a ValueError), and zero their moments."""
        if not 0.0 < ceiling < 1.0:
            raise ArgumentError("ceiling", "a number in (0, 1)", ceiling)
        self._check()
        lowered = self.model.opacity_logits.clamp(max=math.log(ceiling / (1.0 - ceiling)))
        no_rows = torch.empty(0, dtype=torch.int64, device=lowered.device)
        self._replace("opacity_logits", lowered, no_rows)

    @torch.no_grad()
    def decay_opacity(self, factor: float, rows: Tensor | None = None) -> None:
        """Multiply opacities by `factor`, in (0, 1) (else a ValueError), in place; Adam's moments stay.

        `rows`, bool `(N,)`, are the Gaussians whose opacities are meant; None: all.
        """
        if not 0.0 < factor < 1.0:
            raise ArgumentError("factor", "a number in (0, 1)", factor)
        logits = self.model.opacity_logits
        if self._backend.decay_opacity is not None and rows is None and logits.is_contiguous():
            self._backend.decay_opacity(logits, factor)
            increment_version(logits)
            return
        # of f s(x): log f - log(e^-x + 1 - f)
        decayed = math.log(factor) - torch.logaddexp(-logits, logits.new_full((), 1.0 - factor).log())
        logits.copy_(decayed if rows is None else torch.where(rows.to(logits.device), decayed, logits))

    def state_dict(self) -> dict[str, Tensor]:
        """The statistics and the generator's state, for a checkpoint."""
        return {name: x.clone() for name, x in self._statistics.items()} | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned; ValueError if entries are missing or the number of Gaussians differs."""
        shape = (len(self.model),)
        missing = {*self._statistics, "generator"} - state.keys()
        if missing:
            raise ArgumentError("state", "the entries of state_dict", f"none for {sorted(missing)}")
        for name in self._statistics:
            if state[name].shape != shape:
                raise ArgumentError(name, f"shape {shape}", tuple(state[name].shape))
        self._restart_statistics(self.model.means.new_zeros(shape))
        for name, value in self._statistics.items():
            value.copy_(state[name])
        self.generator.set_state(state["generator"].cpu())

    def _gradient_of(self, means2d: Tensor) -> Tensor:
        """The gradients that the last backward pass stored in projected centres, `(M, 2)`."""
        if not means2d.requires_grad:
            why = "the means need requires_grad=True, and the render has to be made with gradients on"
            raise ArgumentError("projected", "means2d that require a gradient", advice=why)
        name = "absgrad" if self.absgrad else "grad"
        is_kept = self.absgrad or means2d.is_leaf or means2d.retains_grad  # torch warns where .grad is not kept
        gradient: Tensor | None = getattr(means2d, name, None) if is_kept else None
        if gradient is None:
            order = "and observe comes after backward"
            why = "the render needs absgrad=True" if self.absgrad else "means2d.retain_grad() comes after the render"
            raise ArgumentError("projected", f"means2d.{name}", "None", advice=f"{why}, {order}")
        return gradient

    def _check_count(self) -> None:
        """Raise a ValueError if the model has another number of Gaussians than the statistics."""
        count = len(self.model)
        expected = len(self._statistics["counts"])
        if count != expected:
            raise ArgumentError("model", f"{expected} Gaussians", count, advice="load the densifier's state too")

    def _check(self) -> None:
        """Raise a ValueError if the model, its statistics and the optimizer's state do not belong together."""
        self._check_count()
        held = {id(parameter) for group in self.optimizer.param_groups for parameter in group["params"]}
        for name, parameter in self.model.per_gaussian().items():
            if id(parameter) not in held:
                raise ArgumentError("optimizer", "it to hold all of the model's parameters", f"none for {name}")
            shape = tuple(parameter.shape)
            for key, entry in self.optimizer.state.get(parameter, {}).items():
                if isinstance(entry, Tensor) and entry.numel() != 1 and entry.shape != shape:
                    got = tuple(entry.shape)
                    raise ArgumentError("optimizer", f"the state {key} of {name} to have shape {shape}", got)

    def _sample_offsets(self, ids: Tensor) -> Tensor:
        """Draw an offset from the centre for each id, from that Gaussian's own distribution."""
        means = self.model.means
        noise = torch.randn((len(ids), 3), generator=self.generator, device=self.generator.device, dtype=means.dtype)
        # a scale may overflow where its logarithm does not; the offset has to stay finite
        scales = self.model.log_scales.index_select(0, ids).exp().clamp(max=math.sqrt(torch.finfo(means.dtype).max))
        rotations = rotation_matrices(self.model.quats.index_select(0, ids))
        return torch.einsum("nij,nj->ni", rotations, scales * noise.to(means.device))

    def _replace(self, name: str, value: Tensor, old_rows: Tensor) -> None:
        """Replace a parameter by `value` in the model, the param group and the optimizer's state.

        State that has the parameter's shape (Adam's moments) starts with its `old_rows`, followed by zeros. The
        parameter is a new object: a live autograd graph would hold the old one to its shape.
        """
        old = self.model.get_parameter(name)
        new = nn.Parameter(value, requires_grad=old.requires_grad)
        for group in self.optimizer.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        if old in self.optimizer.state:
            state = self.optimizer.state.pop(old)
            for key, entry in state.items():
                if isinstance(entry, Tensor) and entry.shape == old.shape:
                    state[key] = entry.new_zeros(value.shape)
                    state[key][: len(old_rows)] = entry.index_select(0, old_rows)
            self.optimizer.state[new] = state
        setattr(self.model, name, new)

    def _restart_statistics(self, last_gradients: Tensor) -> None:
        """Begin new means, with the mean gradients so far `(N,)` as their first observation."""
        last = last_gradients.detach()
        counts = torch.zeros_like(last, dtype=torch.int64)
        self._statistics = {"gradient_sums": torch.zeros_like(last), "counts": counts, "last_gradients": last}
