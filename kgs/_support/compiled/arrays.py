"""The memory of tensors, as kernels read it."""

from typing import Any

import numpy as np
from torch import Tensor

Array = np.ndarray[Any, np.dtype[Any]]


def arrays(*tensors: Tensor) -> tuple[Array, ...]:
    """NumPy arrays in the memory of tensors, or of contiguous copies where a tensor is a view that is not."""
    try:
        return tuple(x.detach().resolve_neg().contiguous().numpy() for x in tensors)
    except RuntimeError as error:  # tensors within a transform have no memory of their own
        raise RuntimeError("tensors: expected plain ones, got those of torch.func or another transform") from error
