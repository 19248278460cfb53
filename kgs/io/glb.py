"""Writes splats as binary glTF 2.0 with the extension KHR_gaussian_splatting, for engines and glTF viewers.

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

_EXTENSION = "KHR_gaussian_splatting"
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # of accessors, by the numbers per Gaussian
# Constants of the glTF specification.
_FLOAT = 5126  # component type
_ARRAY_BUFFER = 34962  # target of a buffer view with vertex attributes
_POINTS = 0  # mode of a primitive


def save_glb(
    path: str | os.PathLike[str], model: GaussianModel, rotation: Tensor, offset: Tensor | None = None
) -> None:
    """Write a model as one binary glTF file, with harmonics up to the active degree. The write is atomic.

    Viewers without support for the extension show the centres as points in the Gaussians' colours.

    Convention:
        glTF's: y is up, lengths are metres. The values are those of the model, in its own frame and in float32. The
        scene is made upright by the rotation and translation of the node; readers rotate the harmonics with the node.
        Quaternions are x, y, z, w of length 1, scales are standard deviations, opacities are in [0, 1], and colours are
        sRGB.

    Args:
        path: the file to write, in an existing folder.
        model: the Gaussians.
        rotation: from the model's world to glTF's, `(3, 3)`, see :func:`kgs.io.cameras.upright`.
        offset: origin of the model's frame in its world, `(3,)`, the `offset` of a Scene; None: zero. It becomes part
            of the node's translation.

    Raises:
        TypeError: `model` is not a GaussianModel.
        ValueError: a value is not finite in float32, or `rotation` or `offset` has the wrong shape.
        OSError: the file cannot be written.
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
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
    }
    content = b""
    if len(model):  # glTF has no empty accessors, so a file without Gaussians has no mesh
        node["mesh"] = 0
        content = b"".join(values.tobytes() for values in attributes.values())
        document |= _mesh(attributes)
        document["buffers"] = [{"byteLength": len(content)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)  # chunks end at multiples of four bytes
    chunks = _chunk(b"JSON", text)
    if content:
        chunks += _chunk(b"BIN\0", content)
    header = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks))
    write_whole(Path(path), header + chunks)


def _mesh(attributes: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
    """The glTF description of vertex attributes that follow each other in buffer 0."""
    splat = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    numbers = {name: i for i, name in enumerate(attributes)}
    primitive = {"mode": _POINTS, "attributes": numbers, "extensions": {_EXTENSION: splat}}
    accessors, views = list[dict[str, Any]](), list[dict[str, Any]]()
    start = 0
    for i, values in enumerate(attributes.values()):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        kind = {"componentType": _FLOAT, "count": len(values), "type": _TYPES[values.shape[1]]}
        accessors.append({"bufferView": i, **kind})
        start += values.nbytes
    positions = attributes["POSITION"]
    accessors[numbers["POSITION"]] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    return {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": views}


def _attributes(model: GaussianModel) -> dict[str, NDArray[np.float32]]:
    """The vertex attributes by name, `(N, width)` each."""
    with torch.no_grad():
        gaussians = model()
        opacities, harmonics = gaussians.opacities[:, None], gaussians.colors
        found = {
            "POSITION": gaussians.means,
            "COLOR_0": torch.cat([_linear_colors(harmonics), opacities], 1),
            f"{_EXTENSION}:ROTATION": _unit_quaternions(gaussians.quats)[:, [1, 2, 3, 0]],
            f"{_EXTENSION}:SCALE": gaussians.scales,
            f"{_EXTENSION}:OPACITY": opacities,
        }
        for k in range(harmonics.shape[1]):
            degree = int(k**0.5)
            found[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = harmonics[:, k]
    return {name: np.ascontiguousarray(value.detach().cpu().numpy(), "<f4") for name, value in found.items()}


def _unit_quaternions(quats: Tensor) -> Tensor:
    """Normalised quaternions w, x, y, z in float64; the identity for zero."""
    quats = quats.double()
    lengths = quats.norm(dim=1, keepdim=True)
    return torch.where(lengths > 0, quats / lengths, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))


def _linear_colors(harmonics: Tensor) -> Tensor:
    """The colours of degree 0, `(N, 3)` float64, from sRGB to linear RGB as COLOR_0 requires."""
    srgb = (SH_C0 * harmonics[:, 0].double() + 0.5).clamp(0, 1)
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a GLB file: length, kind and content."""
    return struct.pack("<I4s", len(content), kind) + content
