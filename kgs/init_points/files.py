"""Initial points from a file: a splat of 3D Gaussian Splatting, or any point cloud or mesh that trimesh reads."""

import re
from pathlib import Path
from typing import Any

import torch
import trimesh
from torch import Tensor

from kgs.errors import DataError
from kgs.harmonics import SH_C0
from kgs.io.ply import load_ply

_MOST_BYTES, _MOST_TEXT = 2**30, 2**26  # trimesh needs about 75 times the size of a text in memory
_PACKED = {b"PK\3\4": "zip", b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zX": "xz", b"7z\xbc\xaf": "7z"}


def read_points(path: Path, origin: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Positions `(P, 3)`, less `origin` `(3,)`, and RGB in [0, 1], `(P, 3)`, of a file's points or vertices; float32.

    Colours are those of degree 0 for a splat, and grey if the file has none. A DataError if the file is missing, broken
    or compressed (a small one can hold more than the memory), is larger than 1 GiB (64 MiB if it is text and no splat),
    or has no points or infinite ones.
    """
    if not path.is_file():
        raise DataError(path, "", "expected a point cloud or mesh, found no such file")
    with open(path, "rb") as file:
        head = file.read(2**13)
    is_ply = head.startswith(b"ply")
    is_splat = is_ply and b" f_dc_0" in head
    is_text = not re.search(rb"^format binary" if is_ply else rb"\0", head, re.MULTILINE)
    most, kind = (_MOST_TEXT, ", the most for a text file") if is_text and not is_splat else (_MOST_BYTES, "")
    if path.stat().st_size > most:
        raise DataError(path, "", f"is larger than {most // 2**20} MiB{kind}")
    for magic, name in _PACKED.items():
        if head.startswith(magic):
            raise DataError(path, "", f"expected a point cloud or mesh, got a {name} archive: unpack it first")
    if is_splat:
        model = load_ply(path, origin=origin)
        points, colors = model.means.detach(), (0.5 + SH_C0 * model.sh_dc.detach()[:, 0]).clamp(0.0, 1.0)
    else:
        points, colors = _cloud(path, origin)
    if not len(points) or not bool(points.isfinite().all()):
        raise DataError(path, "vertices", f"expected finite points, at least one, got {len(points)}")
    return points, colors


def _cloud(path: Path, origin: Tensor | None) -> tuple[Tensor, Tensor]:
    try:
        geometry: Any = trimesh.load(path, process=False, skip_materials=True)
        geometry = geometry.to_geometry() if isinstance(geometry, trimesh.Scene) else geometry
        points = torch.tensor(geometry.vertices, dtype=torch.float64).reshape(-1, 3)
        colors = torch.tensor(geometry.visual.vertex_colors if geometry.visual.kind == "vertex" else [])
    except Exception as error:  # each of trimesh's readers raises what its parser meets
        raise DataError(path, "", f"expected a point cloud or mesh that trimesh reads, got {error!r}") from error
    points = (points if origin is None else points - origin).float()
    if colors.ndim != 2 or len(colors) != len(points) or colors.shape[1] < 3:  # none, or not those of points
        return points, torch.full((len(points), 3), 0.5, dtype=torch.float32)
    return points, colors[:, :3].float() / 255.0
