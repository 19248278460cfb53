"""Splats that are written: read back bit for bit, by others, at map coordinates, and never half."""

import math
import os

import numpy as np
import pytest
import torch
import trimesh
from factories import pinhole, random_model, splat_columns
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from kgs import Densifier, GaussianRenderer
from kgs.app.files.glb import save_glb
from kgs.app.page.data import pack
from kgs.compressed_ply import save_compressed_ply
from kgs.datasets import Views
from kgs.fit.pruning import contributions
from kgs.geometry.types import RasterOptions
from kgs.model import GaussianModel
from kgs.ply import load_ply, save_ply


def same(one, two):
    return all(torch.equal(a.view(torch.int32), b.view(torch.int32)) for a, b in pairs(one, two))


def pairs(one, two):
    return zip(one.parameters(), two.parameters(), strict=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 6])
def test_what_is_written_comes_back_bit_for_bit(tmp_path, degree, n):
    model = random_model(n, degree)
    model.sh_degree = degree // 2
    save_ply(tmp_path / "a.ply", model)
    again = load_ply(tmp_path / "a.ply")
    assert same(model, again)
    assert (again.max_sh_degree, again.sh_degree) == (degree, degree // 2)
    save_ply(tmp_path / "b.ply", again)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@settings(max_examples=25, deadline=None)
@given(
    values=arrays.arrays(
        np.float32, (3, 23), elements=st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=True)
    )
)
def test_any_finite_float32_comes_back_bit_for_bit(tmp_path_factory, values):
    path = tmp_path_factory.getbasetemp() / "any.ply"
    table = torch.from_numpy(values)
    table[:, 3] = table[:, 3].masked_fill((table[:, 3:7] == 0).all(dim=1), 1.0)  # rotations of length 0 are left out
    model = GaussianModel(
        means=table[:, :3],
        quats=table[:, 3:7],
        log_scales=table[:, 7:10],
        opacity_logits=table[:, 10],
        sh_dc=table[:, None, 11:14],
        sh_rest=table[:, 14:].reshape(3, 3, 3),
    )
    save_ply(path, model)
    assert same(model, load_ply(path))


def small_model(n=40, dtype=torch.float32):
    """A splat before a camera at the origin, with Gaussians of some centimetres."""
    model = random_model(n, dtype=dtype)
    with torch.no_grad():
        model.means.mul_(0.3).add_(torch.tensor([0.0, 0.0, 3.0]))
        model.log_scales.mul_(0.3).sub_(3.0)
    return model


UTM = torch.tensor([448262.127, 5411932.678, 118.5], dtype=torch.float64)  # metres, in zone 31


@pytest.mark.parametrize(("offset", "dtype"), [(None, np.float32), (UTM, np.float64)], ids=["floats", "doubles"])
def test_convention_trimesh_reads_all_columns(tmp_path, offset, dtype):
    model = small_model()
    save_ply(tmp_path / "a.ply", model, offset)
    raw = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    read = {name: np.asarray(raw[name]).reshape(-1) for name in splat_columns(3)}
    assert len(read) == 62
    means = model.means if offset is None else model.means.double() + offset
    expected = {name: means[:, i] for i, name in enumerate("xyz")}
    expected |= {name: torch.zeros(len(model)) for name in ("nx", "ny", "nz")}
    expected |= {f"f_dc_{c}": model.sh_dc[:, 0, c] for c in range(3)}
    expected |= {f"f_rest_{15 * c + k}": model.sh_rest[:, k, c] for c in range(3) for k in range(15)}
    expected |= {"opacity": model.opacity_logits}
    expected |= {f"scale_{i}": model.log_scales[:, i] for i in range(3)}
    expected |= {f"rot_{i}": model.quats[:, i] for i in range(4)}
    for name, values in expected.items():
        assert read[name].dtype == (dtype if name in "xyz" else np.float32)
        assert np.array_equal(read[name], values.detach().numpy()), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("in_file", [None, 3])
def test_header_is_that_of_3d_gaussian_splatting_and_higher_harmonics_are_zeros(tmp_path, degree, in_file):
    model = random_model(4, degree)
    model.sh_degree = degree // 2
    save_ply(tmp_path / "a.ply", model, sh_degree=in_file)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    columns = splat_columns(in_file or degree)
    expected = ["ply", "format binary_little_endian 1.0", "element vertex 4"]  # their viewer counts the lines
    expected += [f"property float {name}" for name in columns]
    lines = head.decode().splitlines()
    assert lines[: len(expected)] == expected
    assert all(line.startswith("comment ") for line in lines[len(expected) :])
    assert len(body) == 4 * len(columns) * 4
    again = load_ply(tmp_path / "a.ply")
    assert again.sh_degree == degree // 2
    assert torch.equal(again.sh_rest[:, : model.sh_rest.shape[1]], model.sh_rest)
    assert not again.sh_rest[:, model.sh_rest.shape[1] :].any()
    assert torch.equal(again.quats, model.quats)


@pytest.mark.parametrize("antialiased", [False, True])
def test_an_antialiased_model_is_tagged_as_other_programs_do(tmp_path, antialiased):
    model = random_model()
    model.antialiased = antialiased
    save_ply(tmp_path / "a.ply", model)
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0]
    assert (b"\ncomment SplatRenderMode: mip\n" in head) == antialiased  # the spelling of Brush and splat-transform
    assert load_ply(tmp_path / "a.ply").antialiased == antialiased


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_scene_at_map_coordinates_comes_back_where_it_was(tmp_path, dtype):
    model = small_model(dtype=dtype)
    save_ply(tmp_path / "a.ply", model, UTM)
    again = load_ply(tmp_path / "a.ply", origin=UTM)
    # 1e-9 is what float64 leaves of a metre at 5e6 metres
    torch.testing.assert_close(again.means.double(), model.means.double(), rtol=1e-7, atol=2e-9)
    assert all(torch.equal(a, b.float()) for a, b in list(pairs(again, model))[1:])


def test_a_float64_model_that_is_at_map_coordinates_itself_keeps_them(tmp_path):
    model = small_model(dtype=torch.float64)
    with torch.no_grad():
        model.means.add_(UTM)
    save_ply(tmp_path / "a.ply", model)
    near = load_ply(tmp_path / "a.ply", origin=UTM).means.double() + UTM
    torch.testing.assert_close(near, model.means.detach(), rtol=0, atol=1e-6)


def test_reading_without_an_origin_warns_where_float32_is_too_coarse(tmp_path, recwarn):
    save_ply(tmp_path / "a.ply", small_model(), UTM)
    load_ply(tmp_path / "a.ply", origin=UTM)
    assert not recwarn.list
    with pytest.warns(UserWarning, match=r"pass an origin= near them, \(448262, 5411933, 12[12]\)"):
        load_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("offset", [[1.5, -3.0, 0.1], [0.0, 0.0, 0.0]])
def test_a_usual_offset_keeps_the_layout_that_viewers_expect(tmp_path, offset):
    model, offset = small_model(), torch.tensor(offset, dtype=torch.float64)
    save_ply(tmp_path / "a.ply", model, offset)
    assert b"property float x\n" in (tmp_path / "a.ply").read_bytes()
    again = load_ply(tmp_path / "a.ply")
    assert torch.equal(again.means, (model.means.detach().double() + offset).float())
    assert torch.equal(again.quats, model.quats)


def test_values_that_float32_cannot_hold_are_not_written(tmp_path):
    for value in (math.nan, math.inf, 1e300):
        model = random_model(dtype=torch.float64)
        with torch.no_grad():
            model.sh_rest[1, 2, 0] = value
        with pytest.raises(ValueError, match="got NaN or infinity in f_rest_2"):
            save_ply(tmp_path / "a.ply", model)
    assert not list(tmp_path.iterdir())


DISC = torch.tensor([-1.0, -2.0, -math.inf])  # scales of a flat disc: its third axis has no extent


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_flat_discs_come_back_and_float64_is_rounded_once(tmp_path, dtype):
    model = random_model(20, dtype=dtype)
    with torch.no_grad():
        model.log_scales[2] = DISC
        model.log_scales[4] = -math.inf
    save_ply(tmp_path / "a.ply", model)
    assert same(load_ply(tmp_path / "a.ply"), model.float())


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degrees", [0.0, 50.0, 90.0])
def test_a_flat_disc_has_the_footprint_of_an_ellipse(tmp_path, each_backend, degrees, antialiased):
    model = random_model(1, 0)
    angle = math.radians(degrees)
    with torch.no_grad():
        model.means.copy_(torch.tensor([[0.0, 0.0, 2.0]]))
        model.quats.copy_(torch.tensor([[math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]]))  # about x
        model.log_scales.copy_(DISC)
    save_ply(tmp_path / "a.ply", model)
    model = load_ply(tmp_path / "a.ply")
    renderer = GaussianRenderer(antialiased=antialiased)
    render = renderer(model(), pinhole(40, 48, 50.0, dtype=torch.float32))
    widths = [25.0 * math.exp(-1.0), 25.0 * math.exp(-2.0) * math.cos(angle)]  # pixels: a metre is 25 at 2 metres
    conics = torch.tensor([[1.0 / (widths[0] ** 2 + 0.3), 0.0, 1.0 / (widths[1] ** 2 + 0.3)]])
    torch.testing.assert_close(render.projected.conics, conics, rtol=1e-4, atol=1e-6)
    render.image.sum().backward()
    assert all(bool(parameter.grad.isfinite().all()) for parameter in model.parameters() if parameter.grad is not None)


@pytest.mark.parametrize("antialiased", [False, True])
def test_opacities_of_exactly_one_and_zero(tmp_path, each_backend, antialiased):
    """As other programs write them, whose logits are infinite; large logits have the same opacities in float32."""
    infinite = random_model(4, 0)
    with torch.no_grad():
        infinite.means.copy_(torch.tensor([[0.0, 0.0, 2.0], [0.3, 0.0, 1.5], [0.0, 0.2, 3.0], [0.1, 0.1, 1.0]]))
        infinite.opacity_logits.copy_(torch.tensor([math.inf, 0.5, math.inf, -math.inf]))
    save_ply(tmp_path / "a.ply", infinite)
    model = load_ply(tmp_path / "a.ply")
    assert same(model, infinite)
    assert model().opacities.tolist() == [1.0, torch.tensor(0.5).sigmoid().item(), 1.0, 0.0]
    finite = load_ply(tmp_path / "a.ply")
    with torch.no_grad():
        finite.opacity_logits.clamp_(-200.0, 200.0)
    gradients = []
    images = []
    for each in (model, finite):
        image = GaussianRenderer(antialiased=antialiased)(each(), pinhole(40, 48, 50.0, dtype=torch.float32)).image
        (image**2).sum().backward()
        images.append(image.detach())
        gradients.append([parameter.grad for parameter in each.parameters() if parameter.grad is not None])
    assert torch.equal(*images)
    assert float(images[0].max()) > 0.5
    for one, two in zip(*gradients, strict=True):
        assert one.isfinite().all()
        assert torch.equal(one, two)


def test_what_takes_a_splat_takes_flat_discs_and_opacities_of_one_and_zero(tmp_path):
    model = small_model()
    with torch.no_grad():
        model.log_scales[::2] = DISC
        model.log_scales[1] = -math.inf
        model.opacity_logits[[0, 2]] = math.inf
        model.opacity_logits[5] = -math.inf
    camera = pinhole(40, 48, 50.0, dtype=torch.float32)
    views = Views(camera, torch.rand(1, 3, 40, 48), ("0.png",))
    save_glb(tmp_path / "a.glb", model, torch.eye(3))
    save_compressed_ply(tmp_path / "a.compressed.ply", model)
    assert pack(model(), camera, max_bytes=10**6).layout["count"] == len(model) - 1  # one is invisible
    weights = contributions(model, views, RasterOptions(near_plane=0.01))
    assert weights.isfinite().all()
    assert weights[2] > 0
    densifier = Densifier(model, torch.optim.Adam(model.parameters()), extent=10.0, grad_threshold=0.0)
    render = GaussianRenderer()(model(), camera)
    render.projected.means2d.retain_grad()
    render.image.sum().backward()
    densifier.observe(render.projected)
    densifier.decay_opacity(0.99)
    report = densifier.step()
    assert report.cloned > 0
    assert report.split > 0
    assert all(not bool(parameter.isnan().any()) for parameter in model.parameters())


def test_a_failed_write_leaves_the_file_behind_a_link_and_no_other(tmp_path, monkeypatch):
    name = "n" * 251 + ".ply"  # as long as the file system allows
    (tmp_path / "far").mkdir()
    (tmp_path / "link.ply").symlink_to(tmp_path / "far" / name)
    save_ply(tmp_path / "link.ply", random_model())

    def fail(*_):
        raise OSError(28, "disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_ply(tmp_path / "link.ply", random_model(seed=2))
    assert (tmp_path / "link.ply").is_symlink()
    assert same(load_ply(tmp_path / "far" / name), random_model())
    assert [entry.name for entry in (tmp_path / "far").iterdir()] == [name]
