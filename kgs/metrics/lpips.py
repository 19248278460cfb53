"""LPIPS, the learned perceptual distance, from weight files that the user provides.

Source: R. Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018, eq. 1,
with the linear heads of version 0.1:

    d(x, y) = sum_l mean_hw sum_c w_lc (u_l(x) - u_l(y))^2_hwc

where u_l are the features after the last ReLU of block l, scaled to unit length along the channels.
"""

import math
import zipfile
from collections.abc import Callable
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from kgs._support.errors import ArgumentError, DataError

from .weights import weight_files

# The mean and deviation of ImageNet, as the authors give them for images in [-1, 1].
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
NORM_EPS = 1e-10

# VGG16 in torchvision's order: blocks of convolutions of size 3, each with a ReLU, and between blocks a pooling by 2.
BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
MIN_SIZE = 16  # pixels, the smallest side that is at least 1 after four poolings
MAX_HEADER = 10_000  # bytes of the header of an array


class Lpips(nn.Module):
    """Perceptual distance of two images, by VGG16.

    The state dict has the names of the weight files: torchvision's `features.0.weight`, ... and `lin0` to `lin4`. A
    module made without `load` has random features and heads of ones: a distance, but not LPIPS.
    """

    __call__: Callable[..., Tensor]  # for type checkers, to which torch's says Any

    def __init__(self) -> None:
        super().__init__()
        layers = list[nn.Module]()
        channels = 3
        self.taps = list[int]()  # positions of the ReLUs whose outputs are compared
        for block, widths in enumerate(BLOCKS):
            if block > 0:
                layers.append(nn.MaxPool2d(2, 2))
            for width in widths:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
                channels = width
            self.taps.append(len(layers) - 1)
            self.register_buffer(f"lin{block}", torch.ones(channels))
        self.features = nn.Sequential(*layers)
        self.requires_grad_(False)

    @classmethod
    def load(cls, folder: str | PathLike[str]) -> Self:
        """Read the weights, floating point of any width; the module is frozen, on the CPU, in float32.

        The folder holds `vgg16_features.npz` with the convolutions under torchvision's names (`features.0.weight`,
        OIHW) and `lpips_lin_vgg16.npz` with the heads `lin0` to `lin4`.

        DataError where the folder, a file or an array is missing or wrong.
        """
        with torch.device("meta"):
            module = cls()
        features_path, heads_path = weight_files(folder)
        shapes = {name: tuple(value.shape) for name, value in module.state_dict().items()}
        heads = {name: shape for name, shape in shapes.items() if name.startswith("lin")}
        features = {name: shape for name, shape in shapes.items() if name not in heads}
        module.load_state_dict(_read(heads_path, heads) | _read(features_path, features), assign=True)
        return module.requires_grad_(False).eval()

    def forward(self, image: Tensor, target: Tensor, rescale: bool = True) -> Tensor:
        """Distances >= 0, `(B,)`, of images to their targets, both `(B, 3, H, W)` in [0, 1]; differentiable in both.

        H and W are at least 16. `rescale` scales the images to [-1, 1], the range of the network's training. False
        feeds them in [0, 1], as the published tables of Gaussian splatting do; the two values cannot be compared.
        ValueError for other shapes.
        """
        if image.ndim != 4 or image.shape[1] != 3 or min(image.shape[-2:]) < MIN_SIZE:
            raise ArgumentError("image", f"shape (B, 3, H, W) with H, W >= {MIN_SIZE}", tuple(image.shape))
        if target.shape != image.shape:
            raise ArgumentError("target", f"shape {tuple(image.shape)} as image", tuple(target.shape))
        x = _network_input(image, rescale)
        y = _network_input(target, rescale)
        distance = image.new_zeros(len(image))
        for index, layer in enumerate(self.features):
            x = layer(x)
            y = layer(y)
            if index in self.taps:
                head = self.get_buffer(f"lin{self.taps.index(index)}").view(-1, 1, 1)
                distance = distance + ((_unit(x) - _unit(y)).square() * head).sum(dim=1).mean(dim=(1, 2))
        return distance


def _network_input(image: Tensor, rescale: bool) -> Tensor:
    """The image in the network's range, scaled as ImageNet."""
    if rescale:
        image = 2.0 * image - 1.0
    shift = image.new_tensor(SHIFT).view(3, 1, 1)
    scale = image.new_tensor(SCALE).view(3, 1, 1)
    return (image - shift) / scale


def _unit(features: Tensor) -> Tensor:
    """The features, scaled to unit length along the channels."""
    norm: Tensor = torch.linalg.vector_norm(features, dim=1, keepdim=True)
    return features / (norm + NORM_EPS)


def _read(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """The named arrays of an npz file as float32 tensors, each size checked before it is unpacked."""
    field = ""
    weights = dict[str, Tensor]()
    try:
        with zipfile.ZipFile(path) as archive:
            for field, shape in shapes.items():
                if f"{field}.npy" not in archive.namelist():
                    raise DataError(path, field, f"an array of shape {shape}", "none")
                with archive.open(f"{field}.npy") as file:
                    content = BytesIO(file.read(MAX_HEADER + 8 * math.prod(shape)))
                array = np.lib.format.read_array(content, allow_pickle=False, max_header_size=MAX_HEADER)
                if array.shape != shape or array.dtype.kind != "f" or content.read(1):
                    raise DataError(path, field, f"floats of shape {shape}", f"{array.dtype} {array.shape}")
                with np.errstate(over="ignore"):
                    weights[field] = torch.from_numpy(np.array(array, np.float32, order="C"))
                if not weights[field].isfinite().all():
                    raise DataError(
                        path, field, "finite numbers in the range of float32", "NaN, infinity or larger ones"
                    )
    except DataError:
        raise
    except Exception as error:  # damaged bytes raise whatever zipfile, its codecs and numpy's parser of headers raise
        raise DataError(path, field, "floats in a readable npz file", advice=repr(error)) from error
    return weights
