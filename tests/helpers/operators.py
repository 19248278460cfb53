"""Which operators of torch a piece of code calls."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Operators(TorchDispatchMode):
    """Lists them in `called`, within a `with`."""

    def __init__(self):
        super().__init__()
        self.called: list[torch._ops.OpOverload] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.called.append(func)
        return func(*args, **(kwargs or {}))

    @property
    def names(self) -> list[str]:
        return [func.overloadpacket.__name__ for func in self.called]

    @property
    def launches(self) -> int:
        """How many would be kernels on a GPU."""
        return sum(not func.is_view for func in self.called)
