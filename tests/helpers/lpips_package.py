"""Stands in for the package lpips 0.1.4, which the tests do not need: the names and shapes of its network's state."""

from bisect import bisect
from typing import Literal

from torch import Tensor

from kgs.metrics.lpips import Lpips

_SLICES = (4, 9, 16, 23)  # the layers of VGG16 at which slice 2, 3, 4 and 5 begin


class LPIPS:
    """Random weights; as narrow as the network of kgs."""

    def __init__(self, net: Literal["vgg"]) -> None:
        self.weights = Lpips().state_dict()

    def state_dict(self) -> dict[str, Tensor]:
        state = {"scaling_layer.shift": self.weights["lin0"].new_zeros(1, 3, 1, 1)}
        for name, value in self.weights.items():
            if name.startswith("lin"):
                state[f"{name}.model.1.weight"] = value.reshape(1, -1, 1, 1)
                state[f"lins.{name[3:]}.model.1.weight"] = value.reshape(1, -1, 1, 1)
            else:
                _, layer, kind = name.split(".")
                state[f"net.slice{bisect(_SLICES, int(layer)) + 1}.{layer}.{kind}"] = value
        return state
