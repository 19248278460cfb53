"""Initial points from a file: a splat of 3D Gaussian Splatting, or any point cloud or mesh that trimesh reads."""

import re
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kgs._support.errors import DataError, warn
from kgs.geometry.harmonics import SH_C0
from kgs.ply import load_ply

_MAX_BYTES = 2**30
_MAX_TEXT_BYTES = 2**26  # trimesh needs about 75 times the size of a text in memory
_ARCHIVES = {b"PK\3\4": "zip", b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zX": "xz", b"7z\xbc\xaf": "7z"}


def read_points(path: Path, origin: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Read the points of a splat or a point cloud, or the vertices of a mesh, with their colours.

    Args:
        path: the file.
        origin: subtracted from the positions before they are rounded to float32, `(3,)`.

    Returns:
        Positions `(P, 3)` and RGB in [0, 1] `(P, 3)`, float32. A splat's colours are those of degree 0. A file without
        colours gives grey. Points that are not finite are left out with a warning.

    Raises:
        DataError: the file is missing or broken; it is an archive, since a small one can hold more than the memory; it
            is larger than 1 GiB, or than 64 MiB if it is text and no splat; or it has no finite points.
    """
    if not path.is_file():
        raise DataError(path, "", "a point cloud or mesh", "no such file")
    with open(path, "rb") as file:
        head = file.read(2**13)
    is_ply = head.startswith(b"ply")
    is_splat = is_ply and b" f_dc_0" in head
    binary_mark = rb"^format binary" if is_ply else rb"\0"
    is_text = not re.search(binary_mark, head, re.MULTILINE)
    if is_text and not is_splat:
        _check_size(path, _MAX_TEXT_BYTES, " in a text file")
    else:
        _check_size(path, _MAX_BYTES)
    for magic, name in _ARCHIVES.items():
        if head.startswith(magic):
            raise DataError(path, "", "a point cloud or mesh", f"a {name} archive", advice="unpack it first")
    points, colors = _read_splat(path, origin) if is_splat else _read_cloud(path, is_ply and is_text, origin)
    said = re.search(rb"^element +vertex +(\d+)", head, re.MULTILINE)
    if is_ply and said and not is_splat and int(said[1]) != len(points):
        raise DataError(path, "vertices", f"{int(said[1])} as its header says", len(points))
    is_finite = points.isfinite().all(dim=1)
    count = int(is_finite.sum())
    if not count:
        raise DataError(path, "vertices", "at least one finite point", f"none of {len(points)}")
    if count < len(points):
        warn(f"{path}: left out, since they are not finite: {len(points) - count} of {len(points)} points")
    return points[is_finite], colors[is_finite]


def _check_size(path: Path, max_bytes: int, why: str = "") -> None:
    """Raise a DataError for a file of more than `max_bytes` bytes."""
    if path.stat().st_size > max_bytes:
        raise DataError(path, "", f"at most {max_bytes // 2**20} MiB{why}", "more")


def _read_splat(path: Path, origin: Tensor | None) -> tuple[Tensor, Tensor]:
    """The centres of a splat's Gaussians, and their colours of degree 0."""
    model = load_ply(path, origin=origin)
    colors = 0.5 + SH_C0 * model.sh_dc.detach()[:, 0]
    return model.means.detach(), colors.clamp(0.0, 1.0)


def _read_cloud(path: Path, is_ascii_ply: bool, origin: Tensor | None) -> tuple[Tensor, Tensor]:
    """The vertices that trimesh reads, and their colours or grey; of an ASCII PLY file with all their digits."""
    import trimesh  # loads SciPy and networkx: half a second, which few fits need

    try:
        file: Any = path
        if is_ascii_ply:  # whose header may say float of numbers with more digits, as of map coordinates
            file = BytesIO(re.sub(rb"(?m)^(property +)float(32)?( +[xyz]\s)", rb"\1double\3", path.read_bytes()))
        file_type = "ply" if is_ascii_ply else None
        geometry: Any = trimesh.load(file, file_type=file_type, process=False, skip_materials=True)
        if isinstance(geometry, trimesh.Scene):
            geometry = geometry.to_geometry()
        points = torch.tensor(geometry.vertices, dtype=torch.float64).reshape(-1, 3)
        colors = torch.tensor(geometry.visual.vertex_colors if geometry.visual.kind == "vertex" else [])
    except Exception as error:  # each of trimesh's readers raises whatever its parser does
        raise DataError(path, "", "a point cloud or mesh that trimesh reads", advice=repr(error)) from error
    if origin is not None:
        points = points - origin
    points = points.float()
    has_one_each = colors.ndim == 2 and len(colors) == len(points) and colors.shape[1] >= 3
    # An XYZ file does not say whether colours, normals or shares of 1 follow: of the latter two nothing is left.
    if not has_one_each or not bool(((colors[:, :3] > 1) & (colors[:, :3] < 255)).any()):
        return points, torch.full((len(points), 3), 0.5, dtype=torch.float32)
    return points, colors[:, :3].float() / 255.0
