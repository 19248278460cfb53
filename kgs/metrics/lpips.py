"""LPIPS, the learned perceptual distance, from weight files that the user provides.

Source: R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018, eq. 1,
with the linear heads of version 0.1:

    d(x, y) = sum_l mean_hw sum_c w_lc (u_l(x) - u_l(y))^2_hwc

where u_l are the features after the last ReLU of block l, scaled to unit length along the channels.
"""

import math
import zipfile
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from kgs.errors import DataError

from .weights import weight_files

# The mean and deviation of ImageNet, as the authors give them for images in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
NORM_EPS = 1e-10

# Convolutions (width, size, stride, padding), each with a ReLU, and poolings (size, stride), in torchvision's order.
LAYERS = {
    "alexnet": ((64, 11, 4, 2), (3, 2), (192, 5, 1, 2), (3, 2), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)),
    "vgg16": (
        *(*[(64, 3, 1, 1)] * 2, (2, 2), *[(128, 3, 1, 1)] * 2, (2, 2), *[(256, 3, 1, 1)] * 3, (2, 2)),
        *(*[(512, 3, 1, 1)] * 3, (2, 2), *[(512, 3, 1, 1)] * 3),
    ),
}
# Positions among the layers of the ReLUs whose outputs are compared; and the smallest image they take.
TAPS = {"alexnet": (1, 4, 7, 9, 11), "vgg16": (3, 8, 15, 22, 29)}
MIN_SIZE = {"alexnet": 31, "vgg16": 16}
MAX_HEADER = 10_000  # bytes of an array's


class Lpips(nn.Module):
    """Perceptual distance of two images; `net` is "vgg16" or "alexnet".

    The state dict has the names of the weight files: torchvision's `features.0.weight`, ... and `lin0` to `lin4`. A
    module made without `load` has random features and heads of ones: a distance, but not LPIPS.
    """

    def __init__(self, net: str = "vgg16") -> None:
        super().__init__()
        if net not in TAPS:
            raise ValueError(f"net: expected one of {sorted(TAPS)}, got {net!r}")
        self.net = net
        layers, channels = list[nn.Module](), 3
        for layer in LAYERS[net]:
            if len(layer) == 2:
                layers.append(nn.MaxPool2d(*layer))
                continue
            width, size, stride, padding = layer
            layers += [nn.Conv2d(channels, width, size, stride, padding), nn.ReLU()]
            channels = width
            if len(layers) - 1 in TAPS[net]:
                self.register_buffer(f"lin{TAPS[net].index(len(layers) - 1)}", torch.ones(channels))
        self.features = nn.Sequential(*layers)
        self.requires_grad_(False)

    @classmethod
    def load(cls, folder: str | PathLike[str], net: str = "vgg16") -> Self:
        """Read the weights, floating point of any width; the module is frozen, on the CPU, in float32.

        The folder holds `<net>_features.npz` with the convolutions under torchvision's names (`features.0.weight`,
        OIHW) and `lpips_lin_<net>.npz` with the heads `lin0` to `lin4`. Published tables have `net` "vgg16".

        DataError where the folder, a file or an array is missing or wrong, ValueError for an unknown `net`.
        """
        with torch.device("meta"):
            module = cls(net)
        network, lines = weight_files(folder, net)
        shapes = {name: tuple(value.shape) for name, value in module.state_dict().items()}
        heads = {name: shape for name, shape in shapes.items() if name.startswith("lin")}
        features = {name: shape for name, shape in shapes.items() if name not in heads}
        module.load_state_dict(_read(network, features) | _read(lines, heads), assign=True)
        return module.requires_grad_(False).eval()

    def forward(self, image: Tensor, target: Tensor, rescale: bool = True) -> Tensor:
        """Distances >= 0, `(B,)`, of images to their targets, both `(B, 3, H, W)` in [0, 1]; differentiable in both.

        H and W are at least 16 for "vgg16" and 31 for "alexnet". `rescale` scales the images to [-1, 1], the range of
        the network's training. False feeds them in [0, 1], as the published tables of Gaussian splatting do; the two
        values cannot be compared. ValueError for other shapes.
        """
        smallest, taps = MIN_SIZE[self.net], TAPS[self.net]
        if image.ndim != 4 or image.shape[1] != 3 or min(image.shape[-2:]) < smallest:
            raise ValueError(f"image: expected shape (B, 3, H, W) with H, W >= {smallest}, got {tuple(image.shape)}")
        if target.shape != image.shape:
            raise ValueError(f"target: expected shape {tuple(image.shape)} as image, got {tuple(target.shape)}")
        shift, scale = (image.new_tensor(values).view(3, 1, 1) for values in (SHIFT, SCALE))
        x, y = (((2.0 * value - 1.0 if rescale else value) - shift) / scale for value in (image, target))
        distance = image.new_zeros(len(image))
        for index, layer in enumerate(self.features):
            x, y = layer(x), layer(y)
            if index in taps:
                head = self.get_buffer(f"lin{taps.index(index)}").view(-1, 1, 1)
                distance = distance + ((_unit(x) - _unit(y)).square() * head).sum(dim=1).mean(dim=(1, 2))
        return distance


def _unit(features: Tensor) -> Tensor:
    norm: Tensor = torch.linalg.vector_norm(features, dim=1, keepdim=True)
    return features / (norm + NORM_EPS)


def _read(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """The named arrays of an npz file as float32 tensors, each size checked before it is unpacked."""
    field, weights = "", dict[str, Tensor]()
    try:
        with zipfile.ZipFile(path) as archive:
            for field, shape in shapes.items():
                if f"{field}.npy" not in archive.namelist():
                    raise DataError(path, field, f"expected an array of shape {shape}, got none")
                with archive.open(f"{field}.npy") as file:
                    content = BytesIO(file.read(MAX_HEADER + 8 * math.prod(shape)))
                array = np.lib.format.read_array(content, allow_pickle=False, max_header_size=MAX_HEADER)
                if array.shape != shape or array.dtype.kind != "f" or content.read(1):
                    raise DataError(path, field, f"expected floats of shape {shape}, got {array.dtype} {array.shape}")
                with np.errstate(over="ignore"):
                    weights[field] = torch.from_numpy(np.array(array, np.float32, order="C"))
                if not weights[field].isfinite().all():
                    raise DataError(
                        path, field, "expected finite numbers in the range of float32, got NaN, infinity or larger ones"
                    )
    except DataError:
        raise
    except Exception as error:  # damaged bytes raise whatever zipfile, its codecs and numpy's parser of headers raise
        raise DataError(path, field, f"expected floats in a readable npz file, got {error!r}") from error
    return weights
