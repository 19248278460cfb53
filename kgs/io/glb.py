"""Splats as binary glTF 2.0 with the extension KHR_gaussian_splatting, for engines and viewers of glTF.

Source: Khronos, "glTF 2.0 Specification", sections 3.6, 3.7 and 4.4, and "KHR_gaussian_splatting", ratified 2026.
"""

import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from numpy.typing import NDArray
from torch import Tensor

import kgs
from kgs.harmonics import SH_C0
from kgs.model import GaussianModel
from kgs.types import check_kind

from .json_files import write_whole
from .ply import as_vector

_NAME = "KHR_gaussian_splatting"
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def save_glb(
    path: str | os.PathLike[str], model: GaussianModel, rotation: Tensor, offset: Tensor | None = None
) -> None:
    """Write a model as one binary glTF file, with harmonics up to the active degree; it appears whole or not at all.

    Viewers without the extension show points in the Gaussians' colours.

    Convention:
        glTF's: y is up, metres. The values are those of the model, in its own frame and float32: the node's rotation
        and translation, not the data, make the world upright, and readers turn the harmonics with it. Quaternions are
        x, y, z, w of length 1, scales are standard deviations, opacities lie in [0, 1], colours are sRGB.

    Args:
        path: the file to write; its folder exists.
        model: the Gaussians.
        rotation: from the model's world to glTF's, `(3, 3)`, see :func:`kgs.io.cameras.upright`.
        offset: of the model's frame in its world, `(3,)`; the `offset` of a Scene. It becomes part of the node's
            translation.

    Raises:
        TypeError: `model` is no GaussianModel.
        ValueError: a value is not finite in float32, or `rotation` or `offset` has another shape.
    """
    check_kind("model", model, GaussianModel)
    if tuple(rotation.shape) != (3, 3) or not bool(rotation.isfinite().all()):
        raise ValueError(f"rotation: expected finite numbers of shape (3, 3), got {rotation.tolist()}")
    attributes = _attributes(model)
    for name, values in attributes.items():
        if not np.isfinite(values).all():
            raise ValueError(f"model: expected values that are finite in float32, got others in {name}")
    turn = rotation.double().cpu()
    shift = torch.zeros(3).double() if offset is None else turn @ torch.from_numpy(as_vector("offset", offset))
    quaternion = rotation_matrix_to_quaternion(turn)[[1, 2, 3, 0]]
    node: dict[str, Any] = {"name": "splat", "rotation": quaternion.tolist(), "translation": shift.tolist()}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"kgs {kgs.__version__}"},
        "extensionsUsed": [_NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
    }
    content = b""
    if len(model):  # glTF knows no empty accessors
        node["mesh"] = 0
        about = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        about |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
        numbers = {name: i for i, name in enumerate(attributes)}
        primitive = {"mode": 0, "attributes": numbers, "extensions": {_NAME: about}}
        document["meshes"] = [{"primitives": [primitive]}]
        document["accessors"], document["bufferViews"] = [], []
        for i, values in enumerate(attributes.values()):
            view = {"buffer": 0, "byteOffset": len(content), "byteLength": values.nbytes, "target": 34962}
            kind = {"componentType": 5126, "count": len(values), "type": _TYPES[values.shape[1]]}
            document["bufferViews"].append(view)
            document["accessors"].append({"bufferView": i, **kind})
            content += values.tobytes()
        ends = {"min": attributes["POSITION"].min(0).tolist(), "max": attributes["POSITION"].max(0).tolist()}
        document["accessors"][0] |= ends
        document["buffers"] = [{"byteLength": len(content)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(b"JSON", text + b" " * (-len(text) % 4)) + (_chunk(b"BIN\0", content) if content else b"")
    write_whole(Path(path), struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _attributes(model: GaussianModel) -> dict[str, NDArray[np.float32]]:
    """The vertex attributes by their names, `(N, width)` each, the positions first."""
    with torch.no_grad():
        gaussians = model()
        quats = gaussians.quats.double()
        lengths = quats.norm(dim=1, keepdim=True)
        quats = torch.where(lengths > 0, quats / lengths, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
        opacities, colors = gaussians.opacities[:, None], gaussians.colors
        plain = (SH_C0 * colors[:, 0].double() + 0.5).clamp(0, 1)
        linear = torch.where(plain <= 0.04045, plain / 12.92, ((plain + 0.055) / 1.055) ** 2.4)
        found = {"POSITION": gaussians.means, "COLOR_0": torch.cat([linear, opacities], 1)}
        found |= {f"{_NAME}:ROTATION": quats[:, [1, 2, 3, 0]], f"{_NAME}:SCALE": gaussians.scales}
        found[f"{_NAME}:OPACITY"] = opacities
        for k in range(colors.shape[1]):
            degree = int(k**0.5)
            found[f"{_NAME}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = colors[:, k]
    return {name: np.ascontiguousarray(value.detach().cpu().numpy(), "<f4") for name, value in found.items()}


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<I4s", len(content), kind) + content
