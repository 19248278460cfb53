"""`kgs clean`: what it writes and says, of a finished fit, of a PLY file with cameras and of one alone."""

import numpy as np
import torch
from command import run

from kgs import GaussianModel, load_ply, save_ply


def planted(path, out, offset=0.0):
    """The splat with an oversized Gaussian of degree 1 that hardly shows, all of it shifted."""
    model = load_ply(path)
    values = {name: value.detach().clone() for name, value in model.named_parameters()}
    extra = {name: value[:1].clone() for name, value in values.items()}
    extra["log_scales"] += 10.0
    extra["opacity_logits"].fill_(-9.0)
    extra["means"] = values["means"].median(dim=0, keepdim=True).values
    values = {name: torch.cat([value, extra[name]]) for name, value in values.items()}
    values["sh_rest"] = torch.full((len(values["means"]), 3, 3), 0.01)
    save_ply(out, GaussianModel(**values, antialiased=True), offset=torch.full((3,), offset, dtype=torch.float64))
    return model


def rows_of(path):
    """The rows of a file's vertices, as bytes."""
    content = path.read_bytes()
    count = int(content.partition(b"element vertex ")[2].split(b"\n")[0])
    table = content.partition(b"end_header\n")[2]
    size = len(table) // count
    return [table[i * size : (i + 1) * size] for i in range(count)]


def test_a_fit_loses_no_more_than_it_may_and_its_rows_stay_as_they_are(fitted, tmp_path, capsys):
    before = (fitted / "splat.ply").read_bytes()
    assert run("clean", fitted, "-o", tmp_path / "clean.ply") == 0
    said = capsys.readouterr().out
    assert "train: PSNR" in said
    assert " test: PSNR" in said
    assert (fitted / "splat.ply").read_bytes() == before
    whole = rows_of(fitted / "splat.ply")
    kept = rows_of(tmp_path / "clean.ply")
    assert len(kept) <= len(whole)
    assert set(kept) <= set(whole)


def test_a_file_keeps_its_degree_and_its_tag(fitted, folder, tmp_path, capsys):
    model = planted(fitted / "splat.ply", tmp_path / "planted.ply")
    assert run("clean", tmp_path / "planted.ply", "--cameras", folder, "-o", tmp_path / "clean.ply") == 0
    said = capsys.readouterr().out
    assert "1 oversized," in said
    assert "train: PSNR" in said
    cleaned = load_ply(tmp_path / "clean.ply")
    assert (cleaned.sh_degree, cleaned.antialiased) == (1, True)
    assert len(cleaned) <= len(model)
    assert bool(cleaned.log_scales.max() <= model.log_scales.max())


def test_far_from_the_origin_positions_stay(fitted, tmp_path, capsys):
    """Without cameras; the file has doubles."""
    planted(fitted / "splat.ply", tmp_path / "planted.ply", 4e6)
    assert run("clean", tmp_path / "planted.ply", "-o", tmp_path / "clean.ply") == 0
    streams = capsys.readouterr()
    assert "no photo was compared" in streams.out
    assert streams.err == ""
    origin = torch.full((3,), 4e6, dtype=torch.float64)
    whole, cleaned = (load_ply(tmp_path / name, origin=origin) for name in ("planted.ply", "clean.ply"))
    assert len(whole) // 2 < len(cleaned) < len(whole)
    distances = torch.cdist(cleaned.means.double(), whole.means.double()).amin(1)
    np.testing.assert_allclose(distances.detach(), 0.0, atol=1e-6)
