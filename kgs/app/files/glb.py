"""Writes splats as binary glTF 2.0 with the extension KHR_gaussian_splatting, for engines and glTF viewers.

Source: Khronos, "glTF 2.0 Specification", sections 3.6, 3.7 and 4.4, and "KHR_gaussian_splatting", ratified 2026.
"""

import json
import math
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from kornia.color import rgb_to_linear_rgb
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from numpy.typing import NDArray
from torch import Tensor

from kgs._support.checks import check_kind
from kgs._support.errors import ArgumentError
from kgs._support.json_files import write_whole
from kgs._support.version import __version__
from kgs.geometry.harmonics import SH_C0
from kgs.model import GaussianModel
from kgs.ply import as_vector

_EXTENSION = "KHR_gaussian_splatting"
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # types of accessors, by the count of numbers per Gaussian
# Constants of the glTF specification.
_FLOAT = 5126  # component type
_ARRAY_BUFFER = 34962  # target of a buffer view with vertex attributes
_POINTS = 0  # mode of a primitive


def save_glb(
    path: str | os.PathLike[str], model: GaussianModel, rotation: Tensor, offset: Tensor | None = None
) -> None:
    """Write a model as one binary glTF file, with harmonics up to the active degree. The write is atomic.

    Viewers without support for the extension show the centres as points in the Gaussians' colours. The extension cannot
    say that a model is antialiased.

    Convention:
        glTF's: y is up, lengths are metres. The values are those of the model, in its own frame and in float32. The
        rotation and translation of the node make the scene upright; readers rotate the harmonics with the node.
        Quaternions are x, y, z, w of length 1. Scales are standard deviations. Opacities are in [0, 1]. Colours are
        sRGB. `rotation` `(3, 3)` is that of :func:`kgs.app.files.cameras.upright`; `offset` `(3,)`, that of a Scene,
        becomes the node's translation.

    Raises:
        TypeError: `model` is not a GaussianModel.
        ValueError: a value is not finite in float32, or `rotation` or `offset` has the wrong shape.
        OSError: the file cannot be written.
    """
    check_kind("model", model, GaussianModel)
    if tuple(rotation.shape) != (3, 3) or not bool(rotation.isfinite().all()):
        raise ArgumentError("rotation", "finite numbers of shape (3, 3)", rotation.tolist())
    attributes = _attributes(model)
    for name, values in attributes.items():
        if not np.isfinite(values).all():
            raise ArgumentError("model", "values that are finite in float32", f"NaN or infinity in {name}")
    matrix = rotation.double().cpu()
    quaternion = rotation_matrix_to_quaternion(matrix)[[1, 2, 3, 0]]  # from w, x, y, z to x, y, z, w
    translation = torch.zeros(3, dtype=torch.float64, device="cpu")
    if offset is not None:
        translation = matrix @ torch.from_numpy(as_vector("offset", offset))
    content = b""
    mesh = dict[str, Any]()
    if len(model):  # glTF has no empty accessors, so a file without Gaussians has no mesh
        content = b"".join(values.tobytes() for values in attributes.values())
        mesh = {**_mesh(attributes), "buffers": [{"byteLength": len(content)}]}
    node = {
        "name": "splat",
        "rotation": quaternion.tolist(),
        "translation": translation.tolist(),
        **({"mesh": 0} if mesh else {}),
    }
    document = {
        "asset": {"version": "2.0", "generator": f"kgs {__version__}"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        **mesh,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)  # the length of a chunk is a multiple of four bytes
    chunks = _chunk(b"JSON", text)
    if content:
        chunks += _chunk(b"BIN\0", content)
    header = struct.pack("<4sII", b"glTF", 2, 12 + len(chunks))
    write_whole(Path(path), header + chunks)


def _mesh(attributes: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
    """The glTF description of a mesh whose vertex attributes follow each other in buffer 0."""
    splat = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    indices = {name: i for i, name in enumerate(attributes)}  # of the accessors
    primitive = {"mode": _POINTS, "attributes": indices, "extensions": {_EXTENSION: splat}}
    accessors: list[dict[str, Any]] = []
    buffer_views: list[dict[str, Any]] = []
    start = 0
    for i, values in enumerate(attributes.values()):
        buffer_views.append({"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": _ARRAY_BUFFER})
        kind = {"componentType": _FLOAT, "count": len(values), "type": _TYPES[values.shape[1]]}
        accessors.append({"bufferView": i, **kind})
        start += values.nbytes
    positions = attributes["POSITION"]
    box = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    accessors[indices["POSITION"]].update(box)
    return {"meshes": [{"primitives": [primitive]}], "accessors": accessors, "bufferViews": buffer_views}


def _attributes(model: GaussianModel) -> dict[str, NDArray[np.float32]]:
    """The vertex attributes by name, `(N, width)` each."""
    with torch.no_grad():
        gaussians = model()
        opacities = gaussians.opacities[:, None]
        harmonics = gaussians.colors
        srgb = (SH_C0 * harmonics[:, 0].double() + 0.5).clamp(0, 1)
        linear = rgb_to_linear_rgb(srgb.T[..., None])[..., 0].T  # which COLOR_0 requires; the model's colours are sRGB
        quats = gaussians.quats.double()
        norms = quats.norm(dim=1, keepdim=True)
        units = torch.where(norms > 0, quats / norms, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))  # w, x, y, z
        attributes = {
            "POSITION": gaussians.means,
            "COLOR_0": torch.cat([linear, opacities], 1),
            f"{_EXTENSION}:ROTATION": units[:, [1, 2, 3, 0]],
            f"{_EXTENSION}:SCALE": gaussians.scales,
            f"{_EXTENSION}:OPACITY": opacities,
        }
        for k in range(harmonics.shape[1]):
            degree = math.isqrt(k)
            attributes[f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree**2}"] = harmonics[:, k]
    return {name: np.ascontiguousarray(values.detach().cpu().numpy(), "<f4") for name, values in attributes.items()}


def _chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk of a GLB file: length, kind and content."""
    return struct.pack("<I4s", len(content), kind) + content
