"""Checks of arguments: tensors, intrinsics and types."""

from typing import Any

from torch import Tensor, nn

from .errors import ArgumentError


def check_tensor(name: str, value: Any, like: Tensor | None = None, whose: str = "") -> None:
    """Raise a TypeError where the argument is not a tensor, or not of the dtype and on the device of `like`."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: expected a torch.Tensor, got {type(value).__name__}")
    if like is not None and (value.dtype, value.device) != (like.dtype, like.device):
        raise TypeError(f"{name}: expected {like.dtype} on {like.device}{whose}, got {value.dtype} on {value.device}")


def check_intrinsics(name: str, matrices: Tensor) -> None:
    """Raise a ValueError for intrinsics `(..., 3, 3)` or `(..., 4, 4)` that are not those of a pinhole camera.

    The third row has to be (0, 0, 1), and the fourth row and column those of the unit matrix. This reads the values, so
    on a GPU it waits.
    """
    size = matrices.shape[-1]
    check_intrinsic_rows(name, matrices.detach().reshape(-1, size, size).tolist())


def check_intrinsic_rows(name: str, matrices: list[list[list[float]]]) -> None:
    """The same of matrices whose values were read."""
    for matrix in matrices:
        last_rows = [[float(i == j) for j in range(len(matrix))] for i in range(2, len(matrix))]
        if matrix[2:] != last_rows or any(value != 0.0 for row in matrix[:2] for value in row[3:]):
            why = "to resize the images, scale the first two rows alone: K[:2] /= factor"
            raise ArgumentError(name, "intrinsics with (0, 0, 1) as third row", matrix, advice=why)


def check_kind(name: str, value: Any, kind: type) -> None:
    """Raise a TypeError where the argument is of another type, for instance a model instead of its Gaussians."""
    if not isinstance(value, kind):
        hint = "; call the module and pass the result" if isinstance(value, nn.Module) else ""
        raise TypeError(f"{name}: expected {kind.__name__}, got {type(value).__name__}{hint}")
