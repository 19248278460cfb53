"""Compressed PLY files, read by a reader made from PlayCanvas's description; gsplat's files check that reader."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from compressed_reader import as_model, decode, header
from factories import random_model
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.spatial import cKDTree

import kgs
from kgs.compressed_ply import save_compressed_ply
from kgs.geometry.harmonics import SH_C0

LEVELS = np.array([2047, 1023, 2047])
ANGLE = 0.3  # degrees
VERTEX = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
CHUNK = """
    min_x min_y min_z max_x max_y max_z min_scale_x min_scale_y min_scale_z max_scale_x max_scale_y max_scale_z
    min_r min_g min_b max_r max_g max_b
"""


def parameters(model: kgs.GaussianModel) -> dict[str, np.ndarray[Any, Any]]:
    """Its values in float64."""
    return {name: value.detach().double().numpy() for name, value in model.named_parameters()}


def angles(one: np.ndarray[Any, Any], two: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Between rotations, in degrees."""
    one = one / np.linalg.norm(one, axis=1, keepdims=True)
    two = two / np.linalg.norm(two, axis=1, keepdims=True)
    nearer = np.minimum(np.linalg.norm(one - two, axis=1), np.linalg.norm(one + two, axis=1))
    return np.degrees(4 * np.arcsin(nearer / 2))


def check_within(found: dict[str, Any], true: dict[str, Any]) -> None:
    """The Gaussians of one chunk, in the same order, are within the bounds that the docstring states."""

    def check_range(name: str, value: Any, expected: Any, levels: Any) -> None:
        reach = np.abs(expected).max(0) * 2**-23 + 1e-44
        allowed = 0.5001 * np.ptp(expected, axis=0) / levels + reach
        assert (np.abs(value - expected) <= allowed).all(), name

    check_range("means", found["means"], true["means"], LEVELS)
    check_range("log_scales", found["log_scales"], true["log_scales"], LEVELS)
    check_range("sh_dc", found["sh_dc"][:, 0] * SH_C0 + 0.5, true["sh_dc"][:, 0] * SH_C0 + 0.5, 255)
    assert (angles(found["quats"], true["quats"]) < ANGLE).all()
    opacities = torch.from_numpy(true["opacity_logits"]).sigmoid().numpy()
    assert (np.abs(found["opacities"] - opacities) <= 0.5001 / 255).all()
    bands = found["sh_rest"].shape[1]
    assert (np.abs(found["sh_rest"] - true["sh_rest"][:, :bands].clip(-4, 4)) <= 8.001 / 255).all()
    assert not true["sh_rest"][:, bands:].any()


@pytest.mark.parametrize("n", [1, 2, 256])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_chunk_is_as_exact_as_its_bits(tmp_path: Path, degree: int, n: int) -> None:
    model = random_model(n, degree, seed=n)
    save_compressed_ply(tmp_path / "a.ply", model)
    found = decode(tmp_path / "a.ply")
    assert found["sh_rest"].shape == (n, (degree + 1) ** 2 - 1, 3)
    check_within(found, parameters(model))


@settings(max_examples=40, deadline=None)
@given(
    table=arrays.arrays(
        np.float32,
        st.tuples(st.integers(1, 12), st.just(14)),
        elements=st.floats(-(2.0**120), 2.0**120, width=32),
    ),
    logs=arrays.arrays(np.float32, (12, 3), elements=st.floats(-40, 40, width=32)),
    rest=arrays.arrays(np.float32, (12, 3, 3), elements=st.floats(-6, 6, width=32)),
)
def test_any_finite_values_are_within_the_bounds(tmp_path_factory: Any, table: Any, logs: Any, rest: Any) -> None:
    path = tmp_path_factory.getbasetemp() / "any.ply"
    n = len(table)
    logs = np.maximum(logs[:n], logs[:n].max(1, keepdims=True) - 15.9)
    quats = np.where(np.linalg.norm(table[:, 3:7].astype(float), axis=1)[:, None] < 1e-30, [1, 0, 0, 0], table[:, 3:7])
    values = [table[:, :3], quats.astype("f4"), logs, table[:, 7], table[:, None, 8:11], rest[:n]]
    model = kgs.GaussianModel(*map(torch.from_numpy, values))
    save_compressed_ply(path, model)
    check_within(decode(path), parameters(model))


def test_the_header_is_what_readers_compare_it_with(tmp_path: Path) -> None:
    """PlayCanvas takes a file for a compressed one only with these names in this order, and 9, 24 or 45 harmonics."""
    model = random_model(300, 2)
    model.antialiased = True
    save_compressed_ply(tmp_path / "a.ply", model)
    lines, body = header(tmp_path / "a.ply")
    comments = ["comment kgs sh_degree 2", "comment SplatRenderMode: mip"]
    expected = ["ply", "format binary_little_endian 1.0", *comments, "element chunk 2"]
    expected += [f"property float {name}" for name in CHUNK.split()]
    expected += ["element vertex 300", *(f"property uint {name}" for name in VERTEX)]
    expected += ["element sh 300", *(f"property uchar f_rest_{i}" for i in range(24))]
    assert lines == expected
    assert len(body) == 2 * 72 + 300 * (16 + 24)


@pytest.mark.parametrize("n", [257, 1000])
def test_many_chunks_hold_each_gaussian_once(tmp_path: Path, n: int) -> None:
    model = random_model(n, 1)
    save_compressed_ply(tmp_path / "a.ply", model)
    found = decode(tmp_path / "a.ply")
    true = parameters(model)
    _, rows = cKDTree(true["means"]).query(found["means"])
    assert sorted(rows) == list(range(n))
    true = {name: array[rows] for name, array in true.items()}
    for start in range(0, n, 256):
        part = slice(start, start + 256)
        check_within({k: v[part] for k, v in found.items()}, {k: v[part] for k, v in true.items()})


def test_near_gaussians_share_a_chunk_and_strays_do_not_spoil_the_others(tmp_path: Path) -> None:
    model = random_model(20_000, 0)
    with torch.no_grad():
        model.means.copy_(torch.rand(20_000, 3, generator=torch.Generator().manual_seed(1)))
        model.means[:3] *= 1e5
    save_compressed_ply(tmp_path / "a.ply", model)
    lines, body = header(tmp_path / "a.ply")
    bounds = np.frombuffer(body, "<f4", 79 * 18).reshape(79, 18)
    sides = np.sort((bounds[:, 3:6] - bounds[:, :3]).max(1))
    # 79 cubes of equal size would have sides of 0.23
    assert np.median(sides) < 0.35
    assert (sides > 0.8).sum() <= 3
    assert "element chunk 79" in lines


def test_extremes(tmp_path: Path) -> None:
    """Opacities of 0 and 1, flat discs, points, rotations of zeros, and positions as large as floats are."""
    model = random_model(6, 0)
    largest = torch.finfo(torch.float32).max
    with torch.no_grad():
        model.opacity_logits[:6] = torch.tensor([-1e30, 1e30, -200.0, 200.0, -math.inf, math.inf])
        model.log_scales[0] = torch.tensor([0.0, -math.inf, 1.0])
        model.log_scales[1] = -math.inf
        model.log_scales[2] = 1e30
        model.quats[:2] = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1e-37, 0.0]])
        model.means[0] = torch.tensor([largest, -largest, 0.0])
        model.means[1] = torch.tensor([-largest, largest, 1e-45])
    save_compressed_ply(tmp_path / "a.ply", model)
    found = decode(tmp_path / "a.ply")
    assert found["opacities"].tolist() == [0.0, 1.0, 0.0, 1.0, 0.0, 1.0]
    assert np.isfinite(np.concatenate([array.ravel() for array in found.values()])).all()
    step = 175 / 2046  # between codes: the range holds -87 and 88
    assert found["log_scales"][0] == pytest.approx([0.0, -15.0, 1.0], abs=step)
    assert found["log_scales"][1] == pytest.approx([-87.0] * 3, abs=step)
    assert found["log_scales"][2] == pytest.approx([88.0] * 3, abs=step)
    assert (angles(found["quats"][:2], np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])) < ANGLE).all()
    assert found["means"][:2, :2] == pytest.approx(np.array([[largest, -largest], [-largest, largest]]))


def test_harmonics_go_up_to_the_highest_active_band_that_is_used(tmp_path: Path) -> None:
    model = random_model(5, 3)
    model.sh_degree = 2
    for used, written in ((15, 8), (3, 3), (0, 0)):  # in files of 8, 3 and no harmonics a channel
        with torch.no_grad():
            model.sh_rest[:, used:] = 0.0
        save_compressed_ply(tmp_path / "a.ply", model)
        assert decode(tmp_path / "a.ply")["sh_rest"].shape == (5, written, 3)
        assert ("element sh 5" in header(tmp_path / "a.ply")[0]) == (written > 0)


def test_errors_of_harmonics_below_a_step_cancel_among_neighbours(tmp_path: Path) -> None:
    """A step is 8 / 255; the nearest code alone would be off by 0.0127 to 0.0157 in all of them."""
    model = random_model(4000, 3)
    with torch.no_grad():
        model.sh_rest.mul_(0.003)
    save_compressed_ply(tmp_path / "a.ply", model)
    found = decode(tmp_path / "a.ply")
    _, rows = cKDTree(model.means.detach().numpy()).query(found["means"])
    off = found["sh_rest"] - model.sh_rest.detach().numpy()[rows]
    for start in range(0, 4000, 50):
        assert np.abs(off[start : start + 50].mean(0)).max() < 8 / 255 / 50 * 1.001
    assert np.sqrt((off.mean((1, 2)) ** 2).mean()) < 0.005  # in one Gaussian: 0.0023 of random signs, 0.0157 of equal


def test_the_offset_is_added_in_float64(tmp_path: Path) -> None:
    model = random_model(4, 0)
    offset = torch.tensor([1e4, -2e4, 5.0]).double()
    save_compressed_ply(tmp_path / "a.ply", model, offset)
    expected = model.means.detach().double() + offset
    np.testing.assert_allclose(decode(tmp_path / "a.ply")["means"], expected.numpy(), atol=0.004)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_model_gives_the_same_bytes(tmp_path: Path, dtype: torch.dtype) -> None:
    model = random_model(1500, 3, dtype)
    with torch.no_grad():
        model.means[:700] = model.means[0]  # equal positions
    for name in ("a.ply", "b.ply"):
        save_compressed_ply(tmp_path / name, model)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


NOT_FINITE = [
    (name, value)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
    for value in (math.nan, math.inf)
    if (name, value) != ("opacity_logits", math.inf)  # an opacity of 1
]


@pytest.mark.parametrize(("name", "value"), NOT_FINITE)
def test_what_is_not_finite_is_refused_and_leaves_the_file_as_it_was(tmp_path: Path, name: str, value: float) -> None:
    model = random_model(3)
    with torch.no_grad():
        model.get_parameter(name).view(3, -1)[1, 0] = value
    (tmp_path / "a.ply").write_bytes(b"before")
    with pytest.raises(ValueError, match=f"model: .*{name}"):
        save_compressed_ply(tmp_path / "a.ply", model)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert (tmp_path / "a.ply").read_bytes() == b"before"


def test_convention_the_reader_of_these_tests_reads_what_gsplat_writes(tmp_path: Path) -> None:
    """So that writer and reader have no mistake in common; gsplat rounds harmonics down, in other steps."""
    exporter = pytest.importorskip("gsplat.exporter")
    model = random_model(200, 1)
    with torch.no_grad():
        model.opacity_logits.abs_()  # it leaves faint ones out
    values = [value.detach().clone() for value in model.parameters()]
    means, quats, log_scales, logits, sh_dc, sh_rest = values
    text = exporter.export_splats(means, log_scales, quats, logits, sh_dc, sh_rest, format="ply_compressed")
    (tmp_path / "theirs.ply").write_bytes(text)
    save_compressed_ply(tmp_path / "ours.ply", model)
    theirs = decode(tmp_path / "theirs.ply")
    ours = decode(tmp_path / "ours.ply")
    _, rows = cKDTree(ours["means"]).query(theirs["means"])
    assert sorted(rows) == list(range(200))
    for name in ("means", "log_scales", "opacities", "sh_dc"):
        off = np.abs(theirs[name] - ours[name][rows])
        assert off.max() < 1 / 250, name  # a step, where float32 rounds to the other side of a tie
        assert (off > 1e-5).mean() < 0.01, name
    assert (angles(theirs["quats"], ours["quats"][rows]) < ANGLE).all()
    np.testing.assert_allclose(theirs["sh_rest"], ours["sh_rest"][rows], atol=20 / 255)
    lines = [header(tmp_path / name)[0] for name in ("theirs.ply", "ours.ply")]
    assert lines[0] == [line for line in lines[1] if not line.startswith("comment kgs ")]


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (300, 1), (600, 3)])
def test_load_ply_reads_what_was_written(tmp_path: Path, n: int, degree: int) -> None:
    model = random_model(n, degree, seed=n)
    model.antialiased = True
    offset = torch.tensor([7.0, -8.0, 9.0], dtype=torch.float64)
    save_compressed_ply(tmp_path / "a.ply", model, offset)
    found = kgs.load_ply(tmp_path / "a.ply", offset)
    decoded = decode(tmp_path / "a.ply")
    decoded["means"] -= offset.numpy()
    expected = as_model(decoded)
    for name, value in found.named_parameters():
        torch.testing.assert_close(value, expected.get_parameter(name), rtol=1e-5, atol=1e-5)
    assert (found.sh_degree, found.antialiased) == (degree, True)


def _without(word: str) -> Any:
    """A header without the line of this word."""
    return lambda text: "".join(line for line in text.splitlines(keepends=True) if f" {word}" not in line)


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("chunk", lambda text: text.replace("element chunk 2", "element chunk 1")),
        ("chunk", lambda text: text.replace("element chunk", "element lump")),
        ("min_r", _without("min_r")),
        ("packed_scale", _without("packed_scale")),
        ("sh", lambda text: text.replace("element sh 300", "element sh 299")),
        ("f_rest", _without("f_rest_0")),
    ],
)
def test_a_compressed_file_that_is_none_is_refused(tmp_path: Path, key: str, change: Any) -> None:
    save_compressed_ply(tmp_path / "a.ply", random_model(300, 1, seed=0))
    head, end, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(change(head.decode()).encode() + end + body)
    with pytest.raises(kgs.DataError) as caught:
        kgs.load_ply(tmp_path / "a.ply")
    assert caught.value.key == key
