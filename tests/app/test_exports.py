"""What other programs get beside the PLY file: a compressed one, the cameras, the world upright, PNGs with alpha."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from command import run
from compressed_reader import decode, header
from factories import random_model, random_views
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

import kgs
from kgs._support.json_files import write_json
from kgs.app.cli.render import render
from kgs.app.files import exports
from kgs.app.files.cameras import camera_list, upright
from kgs.app.files.film import path_near_plane
from kgs.app.files.fit_files import EXPORTS
from kgs.app.files.preview import write_preview
from kgs.datasets import Scene
from kgs.fit import Fit
from kgs.geometry.multiview import typical_depths

POINTS = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
SKY = 300 * torch.nn.functional.normalize(torch.randn(450, 3, generator=torch.Generator().manual_seed(1)), dim=1)


@pytest.mark.parametrize("around", [SKY[:0], SKY])
def test_the_bounds_are_those_of_the_scene_not_of_strays_or_a_sky(around: torch.Tensor) -> None:
    """In each entry, as readers take every element of the list for a camera: none of them is anything else."""
    strays = torch.tensor([[900.0, 0.5, 0.5], [0.5, -900.0, 0.5], [0.5, 0.5, 900.0]])
    offset = torch.tensor([1e6, 2e6, -5.0]).double()
    listed = camera_list([random_views(2)], offset, torch.cat([POINTS, strays, around]))
    assert all(
        {"position", "rotation", "img_name", "fx", "fy", "width", "height", "bounds"} <= set(each) for each in listed
    )
    for entry in listed:
        low, high = (torch.tensor(corner, dtype=torch.float64) - offset for corner in entry["bounds"])
        torch.testing.assert_close(low, torch.full((3,), 0.01).double(), atol=0.01, rtol=0)
        torch.testing.assert_close(high, torch.full((3,), 0.99).double(), atol=0.01, rtol=0)
        outside = torch.cat([low > POINTS, high < POINTS], 1).float().mean(0)
        assert ((outside > 0.007) & (outside < 0.013)).all()
    assert all("bounds" not in each for each in camera_list([random_views(2)], offset, torch.zeros(0, 3)))


def test_a_viewers_camera_sees_what_ours_does(tmp_path: Path) -> None:
    """With the reader of the reference viewers in mind: pixel = f R^T (x - position) + the middle."""
    views, offset = random_views(3), torch.tensor([1e6, 2e6, -5.0]).double()
    write_json(tmp_path / "cameras.json", camera_list([views.select([2, 0]), views.select([1])], offset, POINTS))
    listed = json.loads((tmp_path / "cameras.json").read_text())
    assert [(each["id"], each["img_name"]) for each in listed] == [
        (0, views.names[2]),
        (1, views.names[0]),
        (2, views.names[1]),
    ]
    point = torch.tensor([0.3, -0.2, 4.0])
    for entry, index in zip(listed, (2, 0, 1), strict=True):
        ours: PinholeCamera = views.camera(index)
        pixel = ours.project(point[None, None])[0, 0] - torch.stack([ours.cx, ours.cy])[:, 0]
        x, y, z = np.array(entry["rotation"]).T @ (point.double() + offset - torch.tensor(entry["position"])).numpy()
        assert (entry["fx"] * x / z, entry["fy"] * y / z) == pytest.approx(pixel.tolist(), abs=1e-3)
        assert (entry["width"], entry["height"]) == (int(ours.width), int(ours.height))


def test_upright() -> None:
    torch.manual_seed(1)
    turn = torch.linalg.qr(torch.randn(3, 3).double()).Q
    turn *= turn.det().sign()
    tilts = 0.2 * torch.randn(6, 3).double()
    poses = torch.eye(4).double().repeat(6, 1, 1)
    poses[:, :3, :3] = axis_angle_to_rotation_matrix(tilts) @ turn
    found = upright(poses)
    torch.testing.assert_close(found @ found.T, torch.eye(3).double())
    assert found.det() > 0
    up, ahead = found @ -poses[:, 1, :3].mean(0), found @ poses[:, 2, :3].mean(0)
    assert up[1] / up.norm() > 1 - 1e-9
    assert ahead[2] / ahead.norm() < -0.95
    for some in (poses[:1], torch.cat([poses[:1], torch.diag(torch.tensor([-1.0, -1, 1, 1])).double() @ poses[:1]])):
        found = upright(some)  # one camera; two of opposite ups
        torch.testing.assert_close(found @ found.T, torch.eye(3).double())


def fit_of(model: kgs.GaussianModel, origin: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Fit:
    """A fit with this splat, of a scene with this origin."""
    none = torch.zeros(0, 3)
    offset = torch.tensor(origin, dtype=torch.float64)
    scene = Scene(random_views(2), random_views(1), none, none, "none", offset, torch.zeros(3), Path())
    return Fit(scene, model, kgs.RasterOptions())


@pytest.fixture
def fit() -> Fit:
    return fit_of(random_model())


@pytest.mark.parametrize(
    ("origin", "shift"), [((50.0, -30.0, 0.0), (50.0, -30.0, 0.0)), ((5e8, -3e8, 0.0), (0.0, 0.0, 0.0))]
)
def test_the_compressed_file_has_the_axes_of_the_ply_where_floats_can_hold_them(
    tmp_path: Path, origin: Any, shift: Any
) -> None:
    """In map coordinates its origin is that of the scene, the mean of the training cameras' centres."""
    model = random_model(100, 0)
    exports.write_exports(fit_of(model, origin), tmp_path)
    path = tmp_path / "splat.compressed.ply"
    np.testing.assert_allclose(decode(path)["means"], model.means.detach().numpy() + shift, atol=0.005)
    assert "element chunk 1" in header(path)[0]


def test_a_fit_without_gaussians_has_no_compressed_file(tmp_path: Path) -> None:
    exports.write_exports(fit_of(random_model(0)), tmp_path)
    assert not (tmp_path / "splat.compressed.ply").exists()


def test_the_film_that_cannot_be_is_a_note(fit: Fit, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    assert exports.write_exports(fit, tmp_path) == []
    assert {path.name for path in tmp_path.iterdir()} == set(EXPORTS) - {"turntable.mp4"}
    monkeypatch.setattr(exports, "write_film", lambda *_: "no turntable.webm: a reason")
    assert exports.write_exports(fit, tmp_path) == ["no turntable.webm: a reason"]


@pytest.mark.parametrize("background", ["black", "white"])
def test_a_png_with_alpha_over_a_background_is_the_opaque_one(folder: Path, tmp_path: Path, background: Any) -> None:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([-0.5, -1.25, -0.5])
    model = kgs.GaussianModel.from_points(points, torch.rand(300, 3), 0)
    with torch.no_grad():
        model.opacity_logits += 1.0
    kgs.save_ply(tmp_path / "splat.ply", model)
    render(tmp_path / "splat.ply", cameras=folder, out=tmp_path / "clear", background="transparent")
    render(tmp_path / "splat.ply", cameras=folder, out=tmp_path / "opaque", background=background)
    names = sorted(path.name for path in (tmp_path / "opaque").glob("*.png"))
    assert names == sorted(path.name for path in (tmp_path / "clear").glob("*.png"))
    assert len(names) == 6
    for name in names:
        clear = cv2.imread(str(tmp_path / "clear" / name), cv2.IMREAD_UNCHANGED).astype(float)
        opaque = cv2.imread(str(tmp_path / "opaque" / name)).astype(float)
        assert clear.shape[2] == 4
        share = clear[:, :, 3:] / 255
        assert share.min() == 0
        assert share.max() > 0.5
        composed = share * clear[:, :, :3] + (1 - share) * (255 if background == "white" else 0)
        assert np.abs(composed - opaque).max() <= 1.6  # three values, each rounded to 8 bits


def test_the_film_leaves_out_what_is_right_before_its_camera(fit: Fit, tmp_path: Path, monkeypatch: Any) -> None:
    renders: list[Any] = []
    monkeypatch.setattr(exports, "write_film", lambda path, render, views, *_: renders.append(render) or "")
    exports.write_exports(fit, tmp_path)
    camera = fit.scene.train.camera(0)
    nearest = float(typical_depths(fit.model.means, fit.scene.train.cameras)[0])
    camera.extrinsics[0, 2, 3] -= 0.6 * nearest  # among the Gaussians
    with torch.no_grad():
        images = [
            kgs.GaussianRenderer(near_plane=near).eval()(fit.model(), camera).image for near in (0.01, nearest / 2)
        ]
    assert (images[0] - images[1]).abs().max() > 0.01
    torch.testing.assert_close(renders[0](camera), images[1])
    assert path_near_plane(fit.model.means, fit.scene.train.cameras, 1e3) == 1e3  # never nearer than that of the fit


@pytest.mark.parametrize("size", [(30, 60), (60, 30)])
def test_the_still_is_the_middle_of_a_photo(fit: Fit, tmp_path: Path, monkeypatch: Any, size: tuple[int, int]) -> None:
    views = random_views(3, *size)
    seen = []

    def draw(enlarged: Fit, camera: PinholeCamera) -> torch.Tensor:
        seen.append((enlarged.options.eps2d, camera))
        return torch.full((1, 3, int(camera.height), int(camera.width)), 0.5)

    monkeypatch.setattr(Fit, "render", draw)
    write_preview(tmp_path / "preview.jpg", fit, views, 2)
    assert cv2.imread(str(tmp_path / "preview.jpg")).shape == (630, 1200, 3)
    ((eps2d, camera),) = seen
    assert torch.equal(camera.extrinsics[0], views.cameras.extrinsics[2])
    height, width = size
    scale = max(1200 / width, 630 / height)
    assert eps2d == pytest.approx(scale**2 * fit.options.eps2d)  # the image of the fit, enlarged
    x, y = views.camera(2).project(torch.tensor([[[0.3, -0.2, 4.0]]]))[0, 0].tolist()
    expected = (x - (width - 1) / 2) * scale + 1199 / 2, (y - (height - 1) / 2) * scale + 629 / 2
    assert camera.project(torch.tensor([[[0.3, -0.2, 4.0]]]))[0, 0].tolist() == pytest.approx(expected, abs=1e-2)


def test_kgs_export_says_how_many_bytes_are_left(tmp_path: Path, capsys: Any) -> None:
    splat = tmp_path / "splat.ply"
    kgs.save_ply(splat, random_model(300, 1))
    out = tmp_path / "small.compressed.ply"
    for _ in range(2):  # its own file may be replaced
        assert run("export", splat, "-o", out) == 0
    said = capsys.readouterr().out
    assert f"{out}: 300 Gaussians, 0.01 MB of 0.03" in said
    kgs.save_compressed_ply(tmp_path / "same.ply", kgs.load_ply(splat))
    assert out.read_bytes() == (tmp_path / "same.ply").read_bytes()


@pytest.mark.parametrize("save", [kgs.save_ply, kgs.save_compressed_ply])
def test_a_splat_of_another_program_is_never_replaced(tmp_path: Path, capsys: Any, save: Any) -> None:
    model = random_model(300, 1)
    kgs.save_ply(tmp_path / "splat.ply", model)
    theirs = tmp_path / "theirs.ply"
    save(theirs, model)
    theirs.write_bytes(theirs.read_bytes().replace(b"comment kgs sh_degree 1\n", b""))
    before = theirs.read_bytes()
    assert run("export", tmp_path / "splat.ply", "-o", theirs) == 3
    assert "a new file or one that kgs wrote" in capsys.readouterr().err
    assert theirs.read_bytes() == before


def test_an_origin_of_kgs_export_makes_map_coordinates_small(tmp_path: Path) -> None:
    model = random_model(20, 0)
    kgs.save_ply(tmp_path / "map.ply", model, torch.tensor([5e6, 6e6, 100.0]).double())
    out = tmp_path / "map.compressed.ply"
    assert run("export", tmp_path / "map.ply", "-o", out, "--origin", 5000000, 6000000, 100) == 0
    np.testing.assert_allclose(decode(out)["means"], model.means.detach().numpy(), atol=0.01)
