"""gsplat's dict of intermediate results, packed or dense."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kgs.geometry.covariance import conics, reach, variances
from kgs.geometry.types import ProjectedGaussians

_LARGEST_RADIUS = 2e9  # pixels, as an int32


def joined(parts: list[Tensor]) -> Tensor:
    """The parts of all scenes, concatenated; no copy of a single part."""
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def absgrad_hook(means2d: Tensor, rows: Tensor | slice) -> Callable[[Tensor], None]:
    """A hook that stores absolute gradients as gsplat does: in rows of `means2d.absgrad`."""

    def store(absolute: Tensor) -> None:
        if not hasattr(means2d, "absgrad"):
            means2d.absgrad = torch.zeros_like(means2d)  # type: ignore[attr-defined]
        means2d.absgrad.view(-1, 2)[rows] = absolute  # type: ignore[attr-defined]

    return store


class Pairs:
    """The visible pairs (camera, Gaussian) of all scenes, and the layout of their values in gsplat's tensors.

    Packed: one after the other, `(M, ...)`. Dense: `(*batch, C, N, ...)`, 0 for pairs that are not visible.
    """

    def __init__(self, projected: list[ProjectedGaussians], batch: tuple[int, ...], count: int, n: int, packed: bool):
        self.projected = projected
        self.packed = packed
        self.shape = (*batch, count, n)
        self.total = len(projected) * count * n
        self.ids = joined([(b * count + p.camera_ids) * n + p.gaussian_ids for b, p in enumerate(projected)])
        self.counts = [len(p) for p in projected]

    def spread(self, values: Tensor) -> Tensor:
        """Values of the pairs, `(M, ...)`, in gsplat's layout."""
        if self.packed:
            return values
        dense = values.new_zeros(self.total, *values.shape[1:]).index_copy(0, self.ids, values)
        return dense.view(*self.shape, *values.shape[1:])

    def gathered(self, tensor: Tensor) -> list[Tensor]:
        """The inverse of `spread`: for each scene its rows of a tensor in gsplat's layout."""
        if not self.packed:
            tensor = tensor.reshape(self.total, *tensor.shape[len(self.shape) :]).index_select(0, self.ids)
        return list(tensor.split(self.counts))

    def rows(self, b: int) -> Tensor | slice:
        """The rows of a scene's pairs in a tensor of gsplat's layout."""
        begin = sum(self.counts[:b])
        rows = slice(begin, begin + self.counts[b])
        return rows if self.packed else self.ids[rows]

    def meta(self, means2d: Tensor) -> dict[str, Any]:
        """The entries of gsplat's dict that describe the pairs."""
        count, n = self.shape[-2:]
        entries: dict[str, Any] = {name: self.spread(self._joined(name)) for name in ("depths", "opacities")}
        xx, xy, yy, det = variances(self._joined("factors"), self.projected[0].eps2d)
        entries["conics"] = self.spread(conics(xx, xy, yy, det))
        entries["radii"] = self.spread(reach(xx.detach(), yy.detach()).clamp_max(_LARGEST_RADIUS).int())
        images = torch.div(self.ids, max(n, 1), rounding_mode="floor")
        ids = {
            "batch_ids": torch.div(images, count, rounding_mode="floor"),
            "camera_ids": images % count,
            "gaussian_ids": self._joined("gaussian_ids"),
        }
        entries |= ids if self.packed else dict.fromkeys(ids)
        return entries | {"means2d": means2d, "n_batches": len(self.projected), "n_cameras": count}

    def _joined(self, name: str) -> Tensor:
        return joined([getattr(p, name) for p in self.projected])
