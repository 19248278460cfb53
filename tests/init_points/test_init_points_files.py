"""Initial points from files: point clouds, meshes and splats; damaged and packed files are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from factories import with_camera
from fits_in_folders import fit_in
from init_point_scenes import flat
from refusals import refused

import kgs
from kgs._support.errors import DataError
from kgs.app.scene_request import SceneRequest
from kgs.fit import FitConfig
from kgs.fit.run import choose_points
from kgs.init_points import files, initial_points


def test_file_with_colors(tmp_path):
    rng = np.random.default_rng(0)
    points, colors = rng.normal(size=(30, 3)).astype(np.float32), rng.integers(0, 256, (30, 4), dtype=np.uint8)
    trimesh.PointCloud(points, colors=colors).export(tmp_path / "cloud.ply")
    result = initial_points(flat(), "file", file=tmp_path / "cloud.ply")
    assert result.kind == "file"
    assert result.points.dtype == result.colors.dtype == torch.float32
    np.testing.assert_array_equal(result.points.numpy(), points)
    np.testing.assert_allclose(result.colors.numpy(), colors[:, :3] / 255, atol=1e-6)


def test_file_without_colors_is_grey(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "cloud.ply")
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nf 1 2 3\n")
    for name in ("cloud.ply", "mesh.obj"):
        result = initial_points(flat(), "file", file=tmp_path / name)
        assert result.points.shape == (3, 3)
        assert torch.equal(result.colors, torch.full((3, 3), 0.5))


def test_a_splat_gives_its_colours(tmp_path):
    generator = torch.Generator().manual_seed(0)
    points, colors = torch.randn(40, 3, generator=generator), torch.rand(40, 3, generator=generator)
    kgs.save_ply(tmp_path / "splat.ply", kgs.GaussianModel.from_points(points, colors, sh_degree=2))
    result = initial_points(flat(), "file", file=tmp_path / "splat.ply")
    assert torch.equal(result.points, points)
    assert torch.allclose(result.colors, colors, atol=1e-6)


def write_cloud(path, shift):
    """A cloud about a point, and the configuration of a fit that starts from it."""
    points = np.random.default_rng(0).normal(size=(40, 3)) + np.array(shift)
    trimesh.PointCloud(points).export(path)
    return FitConfig(steps=2, init="file", init_file=path)


@pytest.mark.parametrize(("shift", "in_front"), [((0.0, 0.0, -50.0), 0), ((500.0, 0.0, 5.0), 40)])
def test_points_in_another_frame_end_a_fit_before_it_begins(scene, tmp_path, shift, in_front):
    config = write_cloud(tmp_path / "cloud.ply", shift)
    out = tmp_path / "out"
    message = f"cloud.ply: initial points: .* got none of 40, of which {in_front} lie before a camera"
    with pytest.raises(DataError, match=message):
        fit_in(scene, config, out, SceneRequest("somewhere"))
    assert not out.exists()


def test_views_that_show_no_initial_point_are_named(scene, tmp_path, recwarn):
    config = write_cloud(tmp_path / "cloud.ply", (0.0, 0.0, 5.0))
    choose_points(scene, config)
    assert not recwarn.list
    extrinsics = scene.train.cameras.extrinsics.clone()
    extrinsics[1, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0])) @ extrinsics[1, :3]  # turned about
    turned = replace(scene.train, cameras=with_camera(scene.train.cameras, extrinsics))
    with pytest.warns(UserWarning, match=f"none lies in the image of {scene.train.names[1]}$"):
        choose_points(replace(scene, train=turned, train_full_size=None), config)


@pytest.mark.parametrize("kind", ["", "float", "float32", "double"])
def test_the_origin_is_subtracted_before_rounding(tmp_path, kind):
    """At UTM coordinates a float32 is a quarter of a metre, whatever the header of a text says."""
    local = np.random.default_rng(0).normal(size=(20, 3)).round(3)
    origin = np.array([432_100.25, 5_400_000.5, 120.0])
    rows = "\n".join(" ".join(f"{x:.4f}" for x in row) for row in local + origin)
    header = "ply\nformat ascii 1.0\nelement vertex 20\n{}end_header\n" if kind else ""
    file = tmp_path / ("cloud.ply" if kind else "cloud.xyz")
    file.write_text(header.format("".join(f"property {kind} {x}\n" for x in "xyz")) + rows)
    result = initial_points(flat(), "file", file=file, origin=torch.from_numpy(origin))
    np.testing.assert_allclose(result.points.numpy(), local, atol=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_points_that_are_not_finite_are_left_out_and_counted(tmp_path, bad):
    points = np.arange(15.0).reshape(5, 3)
    points[1, 2] = points[3, 0] = bad
    colors = np.arange(20, dtype=np.uint8).reshape(5, 4)
    trimesh.PointCloud(points, colors=colors).export(tmp_path / "cloud.ply", vertex_normal=False)
    with pytest.warns(UserWarning, match="2 of 5 points"):
        result = initial_points(flat(), "file", file=tmp_path / "cloud.ply")
    np.testing.assert_array_equal(result.points.numpy(), points[::2])
    np.testing.assert_allclose(result.colors.numpy(), colors[::2, :3] / 255, atol=1e-6)


def test_a_text_with_fewer_points_than_its_header_says_is_refused(tmp_path):
    """One that was cut short; trimesh refuses such binary files."""
    content = trimesh.PointCloud(np.ones((5, 3))).export(file_type="ply", encoding="ascii")
    path = tmp_path / "cloud.ply"
    path.write_bytes(content.replace(b"element vertex 5", b"element vertex 6"))
    with refused(DataError, path=path, key="vertices", got="5"):
        initial_points(flat(), "file", file=path)


@pytest.mark.parametrize("columns", ["0 0.6 -0.8", "-1 0 0", "1 0.25 0.5"], ids=["normal", "along an axis", "shares"])
def test_what_follows_the_positions_of_a_text_may_be_no_colours(tmp_path, columns):
    """MeshLab writes normals there, Open3D shares of 1: as colours up to 255 they are black."""
    (tmp_path / "cloud.xyz").write_text("".join(f"0 0 {z} {columns}\n" for z in range(4)))
    result = initial_points(flat(), "file", file=tmp_path / "cloud.xyz")
    assert torch.equal(result.colors, torch.full((4, 3), 0.5))


def test_a_file_without_a_finite_point_is_refused(tmp_path):
    """Colours of no points are no table, which was an IndexError."""
    trimesh.PointCloud(np.full((2, 3), np.nan)).export(tmp_path / "cloud.ply")
    with refused(DataError, path=tmp_path / "cloud.ply", key="vertices", got="none of 2"):
        initial_points(flat(), "file", file=tmp_path / "cloud.ply")
    content = trimesh.PointCloud(np.ones((5, 3)), colors=np.full((5, 4), 200, np.uint8)).export(file_type="ply")
    (tmp_path / "cloud.ply").write_bytes(content.replace(b"element vertex", b"element vertey"))
    with refused(DataError, path=tmp_path / "cloud.ply", key="vertices", got="none of 0"):
        initial_points(flat(), "file", file=tmp_path / "cloud.ply")


def test_a_text_is_bounded_before_it_is_read(tmp_path, monkeypatch):
    """What reads text takes some 75 times its size; binary files of the same size are read."""
    properties = "".join(f"property float {x}\n" for x in "xyz")
    header = f"ply\nformat {{}} 1.0\nelement vertex {{}}\n{properties}end_header\n"

    def write(name, start, count):
        with open(tmp_path / name, "wb") as file:
            file.write(start.encode())
            file.truncate(len(start) + 12 * count)
        return tmp_path / name

    count = 2**26 // 12 + 1
    text = header.format("ascii", count)
    for path in (
        write("ascii.ply", text, count),
        write("comment.ply", text.replace("element", "comment format binary\nelement"), count),
        write("cloud.xyz", "0 0 0\n" * 2000, count),
    ):
        with pytest.raises(DataError, match=rf"{path.name}: expected at most 64 MiB in a text file"):
            initial_points(flat(), "file", file=path)
    monkeypatch.setattr(files, "_MAX_TEXT_BYTES", 2**16)
    count = 2**16 // 12 + 1
    binary = write("binary.ply", header.format("binary_little_endian", count), count)
    assert len(initial_points(flat(), "file", file=binary).points) == count
