"""Splats that others wrote, or damaged."""

import math
import random
import re
import struct
import tracemalloc

import pytest
import torch
from factories import random_model, splat_columns
from refusals import refused

from kgs._support.errors import DataError
from kgs.ply import load_ply, save_ply

FORMATS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
FORMATS |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I"}
FORMATS |= {"float32": "f", "float64": "d"}


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


@pytest.mark.parametrize("line", ["element vertex", "property float x", "end_header"])
def test_comments_may_stand_anywhere(tmp_path, line):
    data = handmade(FLOATS, [ROW]).replace(line.encode(), f"comment kgs sh_degree 0\n{line}".encode(), 1)
    (tmp_path / "a.ply").write_bytes(data)
    assert load_ply(tmp_path / "a.ply").means.tolist() == [[0, 1, 2]]


def test_a_comment_cannot_raise_the_degree(tmp_path):
    save_ply(tmp_path / "a.ply", random_model(sh_degree=1))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(data.replace(b"sh_degree 1", b"sh_degree 3"))
    assert load_ply(tmp_path / "b.ply").sh_degree == 1


@pytest.mark.parametrize(
    ("tags", "antialiased"),
    [
        ([], False),
        (["SplatRenderMode: mip"], True),  # Brush, splat-transform
        (["SplatRenderMode: default"], False),
        (["SplatRenderMode: 2dgs"], False),
        (["antialiased 1"], True),  # Postshot
        (["antialiased 0"], False),
        (["splatrendermode mip"], True),
        (["antialiased 1", "SplatRenderMode: default"], False),  # the last one counts, as in splat-transform
        (["SplatRenderMode: default", "antialiased 1"], True),
        (["was not trained with SplatRenderMode: mip"], False),
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_tags_of_antialiased_splats(tmp_path, tags, antialiased, newline):
    lines = [f"comment {tag}" for tag in tags]
    (tmp_path / "a.ply").write_bytes(handmade(FLOATS, [ROW], newline=newline, before=[(lines, b"")]))
    assert load_ply(tmp_path / "a.ply").antialiased is antialiased


def without(name):
    return [(n, k) for n, k in FLOATS if n != name]


GOOD = handmade(FLOATS, [ROW])


@pytest.mark.parametrize(
    ("data", "field", "reason"),
    [
        (b"", "", "expected a PLY file, got one without"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "", "expected a PLY file, got one without"),
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
        (
            handmade([("packed_position", "uint"), ("packed_color", "uint")], [[1, 2]]),
            "chunk",
            "expected one element of that name, got 0",
        ),
        (handmade(FLOATS, [ROW])[:-1], "vertex", "expected 68 bytes after the header, got 67"),
        (handmade(FLOATS, [ROW]) + b"\0", "vertex", "expected 68 bytes after the header, got 69"),
        (handmade(FLOATS, [ROW], after=[(["element e 1", "property int i"], b"\0")]), "vertex", "expected 72 bytes"),
        (handmade(FLOATS, [ROW, ROW], "ascii")[:-5], "vertex", "expected 34 numbers after the header, got 33"),
        (handmade(FLOATS, [ROW], "ascii").replace(b" 2.0", b" two"), "vertex", "nothing but numbers"),
        (handmade(FLOATS, [[*ROW[:9], math.nan, *ROW[10:]]]), "opacity", "got nan in row 0"),
        (handmade(FLOATS, [ROW, [*ROW[:16], math.nan]]), "rot_3", "got nan in row 1"),
        (handmade(FLOATS, [[-math.inf, *ROW[1:]]]), "x", "got -inf in row 0"),
        (handmade(FLOATS, [[*ROW[:11], math.inf, *ROW[12:]]]), "scale_1", "got inf in row 0"),
        (handmade(FLOATS, [[*ROW[:11], math.nan, *ROW[12:]]]), "scale_1", "got nan in row 0"),
        (handmade([("x", "double"), *FLOATS[1:]], [[1e300, *ROW[1:]]]), "x", "finite float32"),
        (handmade(FLOATS, [ROW], "ascii").replace(b" 2.0", b" nan"), "z", "got nan"),
        (handmade(FLOATS, [ROW], "ascii").replace(b" 10.0", b" 1_0"), "vertex", "nothing but numbers"),
        (
            handmade(FLOATS, [[0.0] * 17] * 3),
            "vertex",
            "expected at least one Gaussian, got 3 rows that are none: 3 have a rotation of length 0",
        ),
        (handmade(FLOATS, [[0.0] * 17], "ascii"), "vertex", "got 1 row that is none: 1 has a rotation of length 0"),
        (handmade(FLOATS, [[0.0] * 17] * 2 + [[math.nan] + [0.0] * 16]), "vertex", "3 have a rotation of length 0"),
        (handmade(FLOATS, [ROW], "ascii", count=10**17), "vertex", "numbers after the header, got"),
    ],
)
def test_bad_files_are_described(tmp_path, data, field, reason):
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with refused(DataError, path=path, key=field) as caught:
        load_ply(path)
    assert reason in str(caught.value)


def changed(**values):
    """`ROW` with other values of some properties."""
    return [values.get(name, value) for (name, _), value in zip(FLOATS, ROW, strict=True)]


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_opacities_of_one_and_zero_have_infinite_logits(tmp_path, order):
    rows = [changed(opacity=math.inf), changed(opacity=-math.inf), changed(opacity=1e300 if order == "ascii" else 90.0)]
    (tmp_path / "a.ply").write_bytes(handmade(FLOATS, rows, order))
    assert load_ply(tmp_path / "a.ply")().opacities.tolist() == [1.0, 0.0, 1.0]


NO_ROTATION = {f"rot_{i}": 0.0 for i in range(4)}
NO_GAUSSIANS = [
    ([[0.0] * 17], "1 of 5 Gaussians are left out: 1 has a rotation of length 0"),
    ([changed(**NO_ROTATION | {"rot_2": -0.0})] * 9, "9 of 13 Gaussians are left out: 9 have a rotation of length 0"),
    ([changed(y=math.nan)], "1 of 5 Gaussians are left out: 1 has values that are not finite"),
    ([changed(z=-math.inf), changed(scale_1=math.inf)], "2 of 6 Gaussians are left out: 2 have values that are not"),
    ([changed(f_dc_0=math.nan), [math.nan] * 17], "2 of 6 Gaussians are left out: 2 have values that are not finite"),
    ([changed(rot_0=math.inf), [0.0] * 17], "length 0 and 1 has values that are not finite"),
    ([changed(**NO_ROTATION, x=math.nan)], "1 of 5 Gaussians are left out: 1 has a rotation of length 0"),
]


@pytest.mark.parametrize(("rows", "message"), NO_GAUSSIANS)
@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_rows_that_are_no_gaussians_are_left_out_and_counted(tmp_path, rows, message, order):
    good = [changed(x=float(i)) for i in range(4)]
    path = tmp_path / "a.ply"
    path.write_bytes(handmade(FLOATS, [good[0], *rows, *good[1:]], order))
    with pytest.warns(UserWarning, match=f"a.ply: .*{re.escape(message)}"):
        model = load_ply(path)
    assert model.means[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0]
    assert all(bool(parameter.isfinite().all()) for parameter in model.parameters())


@pytest.mark.parametrize("order", ["binary_little_endian", "ascii"])
def test_memory_is_bounded_by_what_the_header_promises(tmp_path, order):
    path = tmp_path / "a.ply"
    # an ascii file promises more numbers than it has: zero bytes stand in their stead
    path.write_bytes(handmade(FLOATS, [ROW], order, count=20 if order == "ascii" else 1))
    with open(path, "r+b") as file:
        file.truncate(2**32)  # takes no room on the disk
    tracemalloc.start()
    try:
        with pytest.raises(DataError, match="vertex"):
            load_ply(path)
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def test_long_ascii_files_are_read_in_parts_that_cut_no_word(tmp_path):
    rows = [[(31 * i + j) / 7 for j in range(17)] for i in range(2000)]  # about 600 kB
    for newline in ("\n", " "):
        data = handmade(FLOATS, rows, "ascii")
        head, body = data.split(b"end_header\n")
        (tmp_path / "a.ply").write_bytes(head + b"end_header\n" + body.replace(b"\n", newline.encode()))
        means = load_ply(tmp_path / "a.ply").means
        assert torch.equal(means, torch.tensor(rows, dtype=torch.float64)[:, :3].float())


@pytest.mark.parametrize("order", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_a_file_without_gaussians_is_an_empty_model(tmp_path, order):
    (tmp_path / "a.ply").write_bytes(handmade(FLOATS, [], order).rstrip(b"\n") + b"\n")
    assert len(load_ply(tmp_path / "a.ply")) == 0


def test_ascii_positions_are_read_in_double_precision(tmp_path):
    rows = [[5411932.678 + i / 1000, *ROW[1:]] for i in range(9)]
    (tmp_path / "a.ply").write_bytes(handmade(FLOATS, rows, "ascii"))
    x = load_ply(tmp_path / "a.ply", origin=torch.tensor([5411932.678, 0, 0], dtype=torch.float64)).means[:, 0]
    torch.testing.assert_close(x, torch.arange(9.0) / 1000, rtol=0, atol=2e-9)


def test_a_file_that_cannot_be_opened_is_a_data_error(tmp_path):
    for path in (tmp_path / "missing.ply", tmp_path):
        with pytest.raises(DataError, match="expected a (file that can be read|PLY file, got a folder)"):
            load_ply(path)
