"""The guard: its cells, and what its report says of a run beside stored cells."""

import json
import math

import numpy as np
import pytest
from study_rows import made_up

pytest.importorskip("pandas")

from kgs.study.command import study
from kgs.study.grid import read_rows
from kgs.study.guard import STORED, write_guard
from kgs.study.presets import AUTO, AUTO_OFF, GUARD, PAPER, sparse_cells, with_steps

FERN = "llff/fern, 3 views"
FLOWER = "llff/flower, 3 views"
OF_SEEDS = {FERN: (24.0, 24.1, 24.3), FLOWER: (22.0, 22.5, 22.1)}  # stored PSNR of the default


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    data = tmp_path_factory.mktemp("data")
    for scene in GUARD:
        (data / scene).mkdir(parents=True)
    return sparse_cells("guard", data)


@pytest.fixture
def rows_of(cells):
    """Made-up rows of the cells with these scenes, methods and seeds."""

    def rows(scenes=(FERN, FLOWER), methods=(AUTO,), seeds=(0,), change=0.0, lpips=0.1, factor=1.0):
        found = []
        for cell in cells:
            name = f"{cell['scene']}, {cell['views']} views"
            if name not in scenes or cell["method"] not in methods or cell["seed"] not in seeds:
                continue
            row = made_up(cell["scene"], cell["views"], "dense", cell["method"], cell["seed"]) | {"cell": cell}
            psnr = OF_SEEDS[name][cell["seed"]] + change
            row["result"]["test"] |= {"psnr": psnr, "lpips_vgg_unscaled": lpips}
            row["result"] |= {"cpu_seconds": 100.0 * (1 + cell["seed"]) * factor - 17.2, "gaussians": 1000}
            found.append(row)
        return found

    return rows


@pytest.fixture
def stored(rows_of, tmp_path):
    """What is stored: two scenes, the default with three seeds."""
    write_guard(rows_of(methods=(AUTO, AUTO_OFF, PAPER), seeds=(0, 1, 2)), tmp_path / "stored", "command", 40)
    return tmp_path / "stored" / "guard.jsonl"


@pytest.fixture
def report(stored, tmp_path):
    """Writes the report of rows beside the stored ones."""

    def write(rows, stored=stored):
        return write_guard(rows, tmp_path / "new", "COMMAND", 40, stored)

    return write


def table(text, method=AUTO):
    """From a line's first cell and a head to the cell."""
    head, _, *lines = text.split(f"\n{method}:\n\n")[1].split("\n\n")[0].splitlines()
    heads = [cell.strip() for cell in head.strip("|").split("|")]
    found = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {line[0]: dict(zip(heads, line, strict=True)) for line in found}


def noise(scene):
    return math.sqrt(2) * np.std(OF_SEEDS[scene], ddof=1)


def keep(stored, wanted):
    """Leave in the file only the lines of some cells."""
    lines = [line for line in stored.read_text().splitlines() if wanted(json.loads(line)["cell"])]
    stored.write_text("\n".join(lines) + "\n")


def test_what_is_stored_are_the_cells_of_the_preset(cells):
    assert [row["cell"] for row in read_rows(STORED)] == cells
    assert STORED.stat().st_size < 100_000


def test_changes_are_those_to_the_cell_of_the_same_seed(rows_of, report, tmp_path):
    text = report(rows_of(methods=(AUTO, PAPER), change=0.25, lpips=0.098, factor=1.1))
    assert (tmp_path / "new" / "guard.md").read_text(encoding="utf-8") == text.rstrip() + "\n"
    assert "Command: COMMAND." in text
    assert "4 of 40 cells, 4 of them with a stored one." in text
    for method in (AUTO, PAPER):
        line = table(text, method)[FERN]
        assert line["PSNR [dB]"] == "24.25"
        assert line["change of PSNR [dB]"] == f"+0.25 ({noise(FERN):.2f})"
        assert line["change of LPIPS"] == "-0.0020 (0.0000) !"
        # the stored default took 100, 200 and 300 s
        assert line["seconds"] == "110"
        assert line["change of seconds [%]"] == f"+10.0 ({math.sqrt(2) * 50:.1f})"
        assert line["change of Gaussians [%]"] == "+0.0 (0.0)"


def test_the_mean_has_its_interval_over_scenes(rows_of, report):
    new = [*rows_of(scenes=(FERN,), change=0.4), *rows_of(scenes=(FLOWER,), change=0.2)]
    found = table(report(new))
    half = 12.706 * 0.1  # Student's t of one degree of freedom, times half the distance of the two
    assert found["mean of 2 scenes"]["change of PSNR [dB]"] == f"+0.30 [{0.3 - half:+.2f}, {0.3 + half:+.2f}]"
    assert found["mean of 2 scenes"]["PSNR [dB]"] == "23.30"
    assert list(table(report(new[:1]))) == [FERN]


@pytest.mark.parametrize(
    ("noises", "mark", "sentence"),
    [
        (1.9, "", "0 of 4 changes of single scenes are beyond noise"),
        (2.1, " !", "1 of 4 changes of single scenes are beyond noise"),
        (-1.9, "", "0 of 4 changes of single scenes are beyond noise"),
        (-2.1, " !", "1 of 4 changes of single scenes are beyond noise"),
    ],
)
def test_what_is_beyond_two_noises_is_marked(noises, mark, sentence, rows_of, report):
    change = noises * noise(FERN)
    text = report(rows_of(scenes=(FERN,), change=change))
    assert table(text)[FERN]["change of PSNR [dB]"] == f"{change:+.2f} ({noise(FERN):.2f}){mark}"
    assert sentence in text


@pytest.mark.parametrize(
    ("changes", "mark", "sentence"),
    [
        ((0.30, 0.31), " !", "Beyond noise in the mean: auto: PSNR [dB] +"),
        ((-0.30, -0.31), " !", "Beyond noise in the mean: auto: PSNR [dB] -"),
        ((-0.30, 0.31), "", "No mean has changed beyond noise"),
    ],
)
def test_a_mean_is_marked_whose_interval_is_beyond_0(changes, mark, sentence, rows_of, report):
    scenes = zip((FERN, FLOWER), changes, strict=True)
    text = report([row for scene, change in scenes for row in rows_of((scene,), change=change)])
    assert table(text)["mean of 2 scenes"]["change of PSNR [dB]"].endswith(f"]{mark}")
    assert sentence in text


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({"changes": (0.3, 0.31)}, "Yes: it gains in psnr"),
        ({"changes": (0.3, 3.0)}, "No: nothing is gained beyond noise"),
        ({"lpips": 0.09}, "Yes: it gains in lpips"),
        ({"changes": (0.3, 0.31), "factor": 1.2}, "No: it loses too much in seconds"),
        ({"changes": (0.3, 0.31), "lpips": 0.104}, "No: it loses too much in lpips"),
        ({"changes": (-0.2, -0.21), "lpips": 0.09}, "No: it loses too much in psnr"),
        ({"methods": (PAPER,)}, "There is no verdict"),
    ],
)
def test_the_verdict_is_yes_or_no(changes, verdict, rows_of, report):
    """By the interval over two scenes, whose changes of LPIPS are the same."""
    psnr = changes.pop("changes", (0.0, 0.0))
    scenes = zip((FERN, FLOWER), psnr, strict=True)
    assert verdict in report([row for scene, change in scenes for row in rows_of((scene,), change=change, **changes)])


def test_one_scene_gives_no_verdict(rows_of, report):
    assert "There is no verdict" in report(rows_of(scenes=(FERN,), change=9.0))


@pytest.mark.parametrize(
    ("seeds", "stored_seeds", "noises"),
    [((0, 1, 2), (0, 1, 2), f" ({noise(FERN) / math.sqrt(3):.2f})"), ((0,), (0,), "")],
    ids=["more seeds have less noise", "one stored seed tells none"],
)
def test_the_noise_is_told_by_seeds(seeds, stored_seeds, noises, rows_of, report, stored):
    keep(stored, lambda cell: cell["seed"] in stored_seeds)
    text = report(rows_of(seeds=seeds, change=0.1))
    assert table(text)[FERN]["change of PSNR [dB]"] == f"+0.10{noises}"
    assert ("0 of 0 changes of single scenes" in text) == (not noises)


def test_without_stored_cells_of_these_settings_there_are_values_alone(rows_of, report, tmp_path):
    other_steps = rows_of()
    for row in other_steps:
        (row["cell"],) = with_steps([row["cell"]], 30)
    for text in (report(rows_of(), tmp_path / "none.jsonl"), report(other_steps)):
        assert list(table(text)[FERN]) == ["scene", "PSNR [dB]", "LPIPS", "seconds", "Gaussians"]
        assert "There is no verdict" in text
        assert "0 of them with a stored one" in text


def test_a_stored_cell_that_is_missing_leaves_its_scene_out_of_the_mean_change(rows_of, report, stored):
    keep(stored, lambda cell: cell["scene"] == "llff/fern")
    found = table(report(rows_of(change=0.3)))
    assert found[FLOWER]["change of PSNR [dB]"] == "-"
    assert found[FLOWER]["PSNR [dB]"] == "22.30"
    assert found["mean of 2 scenes"]["change of PSNR [dB]"] == "+0.30"


def test_without_weights_lpips_is_left_out(rows_of, report):
    line = table(report(rows_of(lpips=None)))[FERN]
    assert not [head for head in line if "LPIPS" in head]
    assert "change of PSNR [dB]" in line


@pytest.fixture
def folder(rows_of, cells, tmp_path, monkeypatch):
    """A run of the preset on one scene, which is done."""
    rows = rows_of(scenes=(FERN,), methods=(AUTO, AUTO_OFF, PAPER))
    (tmp_path / "sparse.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    fern = [cell for cell in cells if cell["scene"] == "llff/fern"]
    monkeypatch.setattr("kgs.study.presets.sparse_cells", lambda *_: fern)
    monkeypatch.delenv("KGS_DATA", raising=False)
    return tmp_path


def test_seed_0_alone_is_wanted_unless_seeds_are_given(folder, capsys):
    assert study(out=folder, preset="guard", report_only=True) == 0
    assert study(out=folder, preset="guard", report_only=True, seeds=(0, 1, 2)) == 1
    capsys.readouterr()
    assert study(out=folder, preset="guard", list_cells=True) == 0
    assert "3 of 3 are done" in capsys.readouterr().out
    assert study(out=folder, preset="guard", list_cells=True, seeds=(0, 1, 2)) == 0
    assert "3 of 5 are done" in capsys.readouterr().out


def test_the_report_is_printed_and_nothing_is_fitted_again(folder, threads, capsys):
    cells = (folder / "sparse.jsonl").read_bytes()
    assert study(out=folder, preset="guard", scheduler=threads) == 0
    said = capsys.readouterr().out
    assert said.startswith("3 of 3 cells are there")
    assert (folder / "guard.md").read_text(encoding="utf-8") in said
    assert "kgs study --preset guard -o OUT" in said
    assert (folder / "sparse.jsonl").read_bytes() == cells
    assert len(read_rows(folder / "guard.jsonl")) == 3
    assert not (folder / "index.html").exists()
