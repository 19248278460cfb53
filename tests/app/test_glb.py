"""splat.glb, read by trimesh and by a reader made from the specification; its JSON by the schema of Khronos."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from factories import random_model
from trimesh.exchange import gltf

import kgs
from kgs.app.files.glb import save_glb

EXTENSION = "KHR_gaussian_splatting"
OFFSET = torch.tensor([4e6, -2e6, 10.0]).double()
TURN = torch.tensor([[0.0, 0.6, 0.8], [-1.0, 0.0, 0.0], [0.0, -0.8, 0.6]]).double()
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray[Any, Any]]]:
    """The JSON of a file of one primitive, and its attributes; sizes and paddings as section 4.4 asks for."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    rest, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
    content = data[28 + size :]
    assert (size % 4, rest % 4, kind, len(content)) == (0, 0, b"BIN\0", rest)
    assert document["buffers"] == [{"byteLength": rest}]
    values = {}
    for name, number in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        width = WIDTHS[accessor["type"]]
        assert accessor["componentType"] == 5126
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == 4 * width * accessor["count"]
        block = content[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        values[name] = np.frombuffer(block, "<f4").reshape(-1, width).astype(np.float64)
    return document, values


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_file_is_what_the_extension_asks_for(tmp_path: Path, degree: int) -> None:
    model = random_model(20, 3)
    model.sh_degree = degree
    save_glb(tmp_path / "a.glb", model, TURN)
    document, values = read(tmp_path / "a.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert (primitive["mode"], document["extensionsUsed"]) == (0, [EXTENSION])
    assert primitive["extensions"][EXTENSION] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    names = {"POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY"))}
    for band in range(degree + 1):
        names |= {f"{EXTENSION}:SH_DEGREE_{band}_COEF_{n}" for n in range(2 * band + 1)}
    assert set(values) == names
    opacities = values[f"{EXTENSION}:OPACITY"]
    assert ((opacities >= 0) & (opacities <= 1)).all()
    assert (values[f"{EXTENSION}:SCALE"] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(values[f"{EXTENSION}:ROTATION"], axis=1), 1, atol=1e-6)
    assert document["accessors"][0]["min"] == values["POSITION"].min(0).tolist()
    assert document["accessors"][0]["max"] == values["POSITION"].max(0).tolist()


def test_its_json_is_valid_by_khronos_schema(tmp_path: Path) -> None:
    pytest.importorskip("jsonschema")
    save_glb(tmp_path / "a.glb", random_model(), TURN, OFFSET)
    gltf.validate(read(tmp_path / "a.glb")[0])


def test_values_are_those_of_the_ply_file(tmp_path: Path) -> None:
    """By the formulas of both formats, each from its own description."""
    model = random_model(50, 3)
    kgs.save_ply(tmp_path / "a.ply", model)
    save_glb(tmp_path / "a.glb", model, TURN)
    vertex = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    values = read(tmp_path / "a.glb")[1]
    column = {name: np.asarray(vertex[name], np.float64).ravel() for name in vertex.dtype.names}
    means = np.stack([column[name] for name in "xyz"], 1)
    np.testing.assert_array_equal(values["POSITION"], means)
    scales = np.exp(np.stack([column[f"scale_{i}"] for i in range(3)], 1))
    np.testing.assert_allclose(values[f"{EXTENSION}:SCALE"], scales, rtol=1e-6)
    np.testing.assert_allclose(values[f"{EXTENSION}:OPACITY"][:, 0], 1 / (1 + np.exp(-column["opacity"])), atol=1e-6)
    quats = np.stack([column[f"rot_{i}"] for i in (1, 2, 3, 0)], 1)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    np.testing.assert_allclose(values[f"{EXTENSION}:ROTATION"], quats, atol=1e-6)
    dc = np.stack([column[f"f_dc_{i}"] for i in range(3)], 1)
    np.testing.assert_array_equal(values[f"{EXTENSION}:SH_DEGREE_0_COEF_0"], dc)
    for k, (band, n) in enumerate((degree, n) for degree in (1, 2, 3) for n in range(2 * degree + 1)):
        rest = np.stack([column[f"f_rest_{k + 15 * channel}"] for channel in range(3)], 1)
        np.testing.assert_array_equal(values[f"{EXTENSION}:SH_DEGREE_{band}_COEF_{n}"], rest)


def test_the_node_turns_and_moves_the_world(tmp_path: Path) -> None:
    model = random_model(9, 0)
    save_glb(tmp_path / "a.glb", model, TURN, OFFSET)
    scene = trimesh.load_scene(tmp_path / "a.glb")
    matrix, name = scene.graph[scene.graph.nodes_geometry[0]]
    world = scene.geometry[name].vertices @ matrix[:3, :3].T + matrix[:3, 3]
    expected = (model.means.detach().double() + OFFSET) @ TURN.T
    np.testing.assert_allclose(world, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(matrix[:3, :3]), 1, atol=1e-12)


def test_other_viewers_show_points_in_linear_colours(tmp_path: Path) -> None:
    points, colors = torch.rand(4, 3), torch.tensor([[0.0, 0.5, 1.0]] * 4)
    model = kgs.GaussianModel.from_points(points, colors, 0)
    save_glb(tmp_path / "a.glb", model, torch.eye(3))
    found = read(tmp_path / "a.glb")[1]["COLOR_0"]
    np.testing.assert_allclose(found, [[0.0, 0.214041, 1.0, 0.1]] * 4, atol=1e-5)  # sRGB 0.5 by its standard


def test_a_quaternion_of_zero_and_no_gaussians_at_all(tmp_path: Path) -> None:
    model = random_model(3, 0)
    with torch.no_grad():
        model.quats[1] = 0.0
    save_glb(tmp_path / "a.glb", model, torch.eye(3))
    assert read(tmp_path / "a.glb")[1][f"{EXTENSION}:ROTATION"][1].tolist() == [0, 0, 0, 1]
    save_glb(tmp_path / "b.glb", model.select(torch.zeros(3, dtype=torch.bool)), torch.eye(3))
    assert trimesh.load_scene(tmp_path / "b.glb").is_empty


def test_what_is_not_finite_is_refused(tmp_path: Path) -> None:
    model = random_model(3, 0)
    with torch.no_grad():
        model.log_scales[0, 0] = 100.0
    with pytest.raises(ValueError, match=r"model: expected values that are finite in float32.*SCALE"):
        save_glb(tmp_path / "a.glb", model, torch.eye(3))
    assert list(tmp_path.iterdir()) == []
