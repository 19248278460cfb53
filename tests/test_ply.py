import math
import os
import random
import struct

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from kgs.errors import DataError
from kgs.model import GaussianModel
from kgs.ply import load_ply, save_ply

SIZES = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
ALIASES = {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
FORMATS = SIZES | ALIASES | {"float32": "f", "float64": "d"}


def make(n=5, degree=3, dtype=torch.float32, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "opacity_logits": (n,), "sh_dc": (n, 1, 3)}
    shapes["sh_rest"] = (n, (degree + 1) ** 2 - 1, 3)
    return GaussianModel(**{k: torch.randn(v, generator=generator, dtype=dtype) for k, v in shapes.items()})


BEFORE_REST = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
AFTER_REST = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def splat_columns(degree=0):
    """Names as the files of 3D Gaussian Splatting have them."""
    rest = {0: 0, 1: 9, 2: 24, 3: 45}[degree]
    return [*BEFORE_REST, *(f"f_rest_{i}" for i in range(rest)), *AFTER_REST]


def handmade(columns, rows, order="binary_little_endian", newline="\n", before=(), after=(), count=None):
    """Bytes of a PLY: columns are (name, type), rows lists of numbers; before and after are (header lines, bytes)."""
    lines = ["ply", f"format {order} 1.0", "comment made by hand"]
    for header, _ in before:
        lines += header
    lines += [f"element vertex {len(rows) if count is None else count}"]
    lines += [f"property {kind} {name}" for name, kind in columns]
    for header, _ in after:
        lines += header
    head = (newline.join([*lines, "end_header"]) + newline).encode()
    if order == "ascii":
        body = "\n".join(" ".join(repr(value) for value in row) for row in rows).encode() + b"\n"
    else:
        code = ("<" if order == "binary_little_endian" else ">") + "".join(FORMATS[kind] for _, kind in columns)
        body = b"".join(struct.pack(code, *row) for row in rows)
    return head + b"".join(data for _, data in before) + body + b"".join(data for _, data in after)


def same(one, two):
    return all(torch.equal(a.view(torch.int32), b.view(torch.int32)) for a, b in pairs(one, two))


def pairs(one, two):
    return zip(one.state_dict().values(), two.state_dict().values(), strict=True)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 6])
def test_what_is_written_comes_back_bit_for_bit(tmp_path, degree, n):
    model = make(n, degree)
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


def test_trimesh_reads_all_columns(tmp_path):
    model = make()
    save_ply(tmp_path / "a.ply", model)
    raw = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    read = {name: np.asarray(raw[name]).reshape(-1) for name in splat_columns(3)}
    assert len(read) == 62
    expected = {name: model.means[:, i] for i, name in enumerate("xyz")}
    expected |= {name: torch.zeros(5) for name in ("nx", "ny", "nz")}
    expected |= {f"f_dc_{c}": model.sh_dc[:, 0, c] for c in range(3)}
    expected |= {f"f_rest_{15 * c + k}": model.sh_rest[:, k, c] for c in range(3) for k in range(15)}
    expected |= {"opacity": model.opacity_logits}
    expected |= {f"scale_{i}": model.log_scales[:, i] for i in range(3)}
    expected |= {f"rot_{i}": model.quats[:, i] for i in range(4)}
    for name, values in expected.items():
        assert read[name].dtype == np.float32
        assert np.array_equal(read[name], values.detach().numpy()), name


def test_header_is_that_of_3d_gaussian_splatting(tmp_path):
    save_ply(tmp_path / "a.ply", make(n=4, degree=1))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines[2:] if not line.startswith("comment")] == [
        "element vertex 4",
        *(f"property float {name}" for name in splat_columns(1)),
    ]
    assert len(body) == 4 * 26 * 4


def test_offset_is_added_in_double_precision(tmp_path):
    model = make()
    offset = torch.tensor([1e6 + 1 / 3, -3.0, 0.1], dtype=torch.float64)
    save_ply(tmp_path / "a.ply", model, offset)
    again = load_ply(tmp_path / "a.ply")
    assert torch.equal(again.means, (model.means.detach().double() + offset).float())
    assert torch.equal(again.quats, model.quats)
    with pytest.raises(ValueError, match=r"offset: expected shape \(3,\), got \(1, 3\)"):
        save_ply(tmp_path / "a.ply", model, offset[None])


def test_a_float64_model_is_rounded_once(tmp_path):
    model = make(dtype=torch.float64)
    save_ply(tmp_path / "a.ply", model)
    assert same(load_ply(tmp_path / "a.ply"), model.float())


@pytest.mark.parametrize("order", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_shuffled_properties_of_any_type_are_found_by_name(tmp_path, order, newline):
    shuffler = random.Random(3)
    names = [*splat_columns(1), "red", "confidence"]
    shuffler.shuffle(names)
    kinds = shuffler.sample(sorted(FORMATS), len(FORMATS))
    columns = [(name, kinds[i % len(kinds)]) for i, name in enumerate(names)]
    whole = {name: FORMATS[kind] not in "fd" for name, kind in columns}
    # integers where the type wants them, else eighths, which float32 holds exactly
    rows = [[shuffler.randrange(100) / (1 if whole[name] else 8) for name in names] for _ in range(4)]
    rows = [[int(v) if whole[name] else v for name, v in zip(names, row, strict=True)] for row in rows]
    path = tmp_path / "a.ply"
    path.write_bytes(handmade(columns, rows, order, newline))
    model = load_ply(path)
    read = {name: torch.tensor([float(row[i]) for row in rows]) for i, name in enumerate(names)}
    assert torch.equal(model.means, torch.stack([read[name] for name in "xyz"], 1))
    assert torch.equal(model.opacity_logits, read["opacity"])
    assert torch.equal(model.log_scales, torch.stack([read[f"scale_{i}"] for i in range(3)], 1))
    assert torch.equal(model.quats, torch.stack([read[f"rot_{i}"] for i in range(4)], 1))
    assert torch.equal(model.sh_dc[:, 0], torch.stack([read[f"f_dc_{i}"] for i in range(3)], 1))
    for band in range(3):
        for channel in range(3):
            assert torch.equal(model.sh_rest[:, band, channel], read[f"f_rest_{3 * channel + band}"])
    assert model.sh_degree == 1


ROW = [float(i) for i in range(17)]
FLOATS = [(name, "float") for name in splat_columns()]


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_other_elements_are_skipped(tmp_path, order):
    packed = order != "ascii"
    chunk = (["element chunk 2", "property double low", "property uchar flag"], struct.pack("<dBdB", 1, 2, 3, 4))
    face = (["element face 1", "property list uchar int vertex_indices"], struct.pack("<B3i", 3, 0, 1, 2))
    data = handmade(
        FLOATS,
        [ROW, ROW],
        order,
        before=[(chunk[0], chunk[1] if packed else b"1.0 2 3.0 4\n")],
        after=[(face[0], face[1] if packed else b"3 0 1 2\n")],
    )
    (tmp_path / "a.ply").write_bytes(data)
    assert load_ply(tmp_path / "a.ply").means.tolist() == [[0, 1, 2], [0, 1, 2]]


def test_a_comment_cannot_raise_the_degree(tmp_path):
    save_ply(tmp_path / "a.ply", make(degree=1))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"sh_degree 1", b"sh_degree 3"))
    assert load_ply(tmp_path / "b.ply").sh_degree == 1


def without(name):
    return [(n, k) for n, k in FLOATS if n != name]


GOOD = handmade(FLOATS, [ROW])


@pytest.mark.parametrize(
    ("data", "field", "reason"),
    [
        (b"", "", "not a PLY file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "", "not a PLY file"),
        (b"ply\n", "header", "end_header"),
        (b"ply\n" + b"x" * 200_000, "header", "within 65536 bytes"),
        (b"ply\n" + b"comment long\n" * 10_000, "header", "within 65536 bytes"),
        (GOOD.replace(b"format binary_little_endian 1.0\n", b""), "format", "got none"),
        (GOOD.replace(b"little_endian 1.0", b"middle_endian 1.0"), "header", "binary_middle_endian"),
        (GOOD.replace(b"float opacity", b"half opacity"), "header", "property half opacity"),
        (GOOD.replace(b"float opacity", b"float x"), "header", "property float x"),
        (GOOD.replace(b"element vertex 1", b"element vertex -1"), "header", "element vertex -1"),
        (GOOD.replace(b"element vertex 1", b"element vertex " + b"9" * 40), "header", "999"),
        (GOOD.replace(b"element vertex 1", b"element vertex 99999999999999999"), "vertex", "bytes after the header"),
        (GOOD.replace(b"element vertex 1", b"element point 1"), "vertex", "got 0"),
        (GOOD.replace(b"float nx", b"list uchar float nx"), "vertex", "no list property"),
        (handmade(FLOATS, [ROW], before=[(["element f 1", "property list uchar int i"], b"\0")]), "vertex", "list"),
        (handmade(without("opacity"), [ROW[1:]]), "opacity", "got none"),
        (handmade(without("rot_3"), [ROW[1:]]), "rot_3", "got none"),
        (handmade([("x", "float"), ("y", "float"), ("z", "float")], [[0, 1, 2]]), "f_dc_0", "got none"),
        (handmade([*FLOATS, ("f_rest_0", "float")], [[*ROW, 1.0]]), "f_rest", "got 1"),
        (
            handmade([*FLOATS, *((f"f_rest_{i + 1}", "uchar") for i in range(9))], [[*ROW, *range(9)]]),
            "f_rest_0",
            "got",
        ),
        (handmade([], [], count=10**17), "x", "got none"),
        (handmade(FLOATS, [ROW])[:-1], "vertex", "expected 68 bytes after the header, got 67"),
        (handmade(FLOATS, [ROW]) + b"\0", "vertex", "expected 68 bytes after the header, got 69"),
        (handmade(FLOATS, [ROW], after=[(["element e 1", "property int i"], b"\0")]), "vertex", "expected 72 bytes"),
        (handmade(FLOATS, [ROW, ROW], "ascii")[:-5], "vertex", "expected 34 numbers after the header, got 33"),
        (handmade(FLOATS, [ROW], "ascii").replace(b" 2.0", b" two"), "vertex", "two"),
        (handmade(FLOATS, [[*ROW[:9], math.inf, *ROW[10:]]]), "opacity", "got inf in row 0"),
        (handmade(FLOATS, [ROW, [*ROW[:16], math.nan]]), "rot_3", "got nan in row 1"),
        (handmade([("x", "double"), *FLOATS[1:]], [[1e300, *ROW[1:]]]), "x", "finite float32"),
        (handmade(FLOATS, [ROW], "ascii").replace(b" 2.0", b" nan"), "z", "got nan"),
    ],
)
def test_bad_files_are_described(tmp_path, data, field, reason):
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with pytest.raises(DataError) as caught:
        load_ply(path)
    assert (caught.value.path, caught.value.field) == (path, field)
    assert reason in caught.value.reason


def test_a_file_that_cannot_be_opened_is_a_data_error(tmp_path):
    for path in (tmp_path / "missing.ply", tmp_path):
        with pytest.raises(DataError, match="cannot be read"):
            load_ply(path)


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_mutated_and_truncated_files_load_or_raise_data_errors(tmp_path, order):
    path = tmp_path / "a.ply"
    data = handmade([(name, "float") for name in splat_columns(1)], [[0.5 * i for i in range(26)]] * 3, order)
    mutator = random.Random(1)
    refused = 0
    for trial in range(400):
        damaged = bytearray(data)
        if trial % 2:
            del damaged[mutator.randrange(len(data)) :]
        else:
            for _ in range(mutator.randint(1, 4)):
                damaged[mutator.randrange(len(data))] = mutator.randrange(256)
        path.write_bytes(damaged)
        try:
            model = load_ply(path)
        except DataError:
            refused += 1
        else:
            assert all(bool(torch.isfinite(parameter).all()) for parameter in model.parameters())
    assert refused > 200


def test_values_that_float32_cannot_hold_are_not_written(tmp_path):
    for value in (math.nan, math.inf, 1e300):
        model = make(dtype=torch.float64)
        with torch.no_grad():
            model.sh_rest[1, 2, 0] = value
        with pytest.raises(ValueError, match="finite in float32, got others in f_rest_2"):
            save_ply(tmp_path / "a.ply", model)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save_ply(path, make(seed=1))
    before = path.read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_ply(path, make(seed=2))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.ply"]
