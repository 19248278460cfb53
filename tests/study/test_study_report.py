"""The report of the study of sparse views, on made-up cells."""

import base64
import csv
import math
import re
from functools import cache

import numpy as np
import pytest
from study_rows import ABLATIONS, MAIN, full, made_up, psnrs, student

pytest.importorskip("pandas")

from kgs import __version__
from kgs.study.plots import STYLES
from kgs.study.presets import FAMILIES, METHODS
from kgs.study.report import write_report

TEXTS = ("sparse.csv", "sparse.md", "index.html")
PLOTS = ("forest.png", "curves.png", "gap.png", "cost.png", "coadaptation.png", "thresholds.png")


def interval(differences, decimals=2):
    half = student(len(differences) - 1) * np.std(differences, ddof=1) / math.sqrt(len(differences))
    mean = np.mean(differences)
    return f"{mean:+.{decimals}f} [{mean - half:+.{decimals}f}, {mean + half:+.{decimals}f}]"


def lines(markdown, title, *names):
    """The cells of a table's lines that have these names among them."""
    table = markdown.split(f"{title}")[1].split("\n\n")[1]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return [row for row in rows if set(names) <= set(row)]


FULL = full()
CASES = {
    "full": FULL,
    "partial": FULL[:4],  # off and one seed of another method
    "one cell": FULL[:1],
    "other starts alone": [row for row in FULL if row["cell"]["start"] in ("sift", "model-points")],
    "main methods missing": [
        made_up("llff/fern", 3, "dense", "off", 0),
        made_up("llff/flower", 3, "dense", "far", 0),
        made_up("llff/fern", 3, "sift", "progressive 0.2", 1),
    ],
    "unknown method, no LPIPS": [made_up("synthetic", 3, "dense", name, 0, lpips=False) for name in ("off", "<b> & _")],
}


@pytest.fixture(scope="module", autouse=True)
def _coarse_plots():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgs.study.plots.DPI", 40)  # time
        yield


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """From the name of a case to its report: the folder, and what was returned."""
    folder = tmp_path_factory.mktemp("reports") / "new"

    @cache
    def written(case):
        out = folder / str(list(CASES).index(case))
        return out, write_report(CASES[case], out, "kgs study --preset cpu", 99)

    return written


@pytest.fixture(scope="module")
def markdown(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("kgs.study.report.write_plots", lambda *_: {})  # time
        return write_report(FULL, tmp_path_factory.mktemp("text") / "new", "kgs study --preset cpu", 99)


QUICK = "other starts alone"
SLOW = [pytest.param(case, marks=pytest.mark.slow) for case in CASES if case != QUICK]


@pytest.mark.parametrize("case", [QUICK, *SLOW])
def test_every_part_of_the_study_gives_sound_files(case, report):
    rows, (out, text) = CASES[case], report(case)
    assert text == (out / "sparse.md").read_text()
    for name in TEXTS:
        content = (out / name).read_text()
        visible = re.sub(r'src="data[^"]*"', "", content)
        assert not re.search(r"\b(nan|inf|none)\b", visible, re.IGNORECASE), name
    with (out / "sparse.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    assert [row["method"] for row in found] == [row["cell"]["method"] for row in rows]
    assert all(None not in row and None not in row.values() for row in found)
    page = (out / "index.html").read_text()
    images = re.findall(r'<img[^>]*src="data:image/png;base64,([^"]*)"', page)
    drawn = {path.read_bytes() for path in out.glob("*.png")}
    assert page.count("<img") == len(images) == len(drawn)
    assert {base64.b64decode(image) for image in images} == drawn
    assert not re.search(r"<script|<link|@import|src=\"(?!data:)", page)
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert page.count("<tr>") == len(tables) - sum(line.startswith("| ---") for line in tables)


def test_each_method_has_a_look_of_its_own_and_a_table():
    assert len(set(STYLES.values())) == len(STYLES)
    assert STYLES.keys() == METHODS.keys() == {*MAIN, *(name for family in FAMILIES.values() for name in family)}


@pytest.mark.parametrize(
    ("case", "names"),
    [
        pytest.param("full", set(PLOTS), marks=pytest.mark.slow),
        pytest.param("one cell", set(PLOTS) - {"forest.png"}, marks=pytest.mark.slow),
        ("other starts alone", set()),
    ],
)
def test_plots_are_drawn_of_what_is_there(case, names, report):
    assert {path.name for path in report(case)[0].glob("*.png")} == names


@pytest.mark.slow
def test_plots_without_data_are_left_out(tmp_path):
    rows = full()[:1]
    rows[0]["result"] |= {"curve": [], "coadaptation": None, "thresholds": None, "cpu_seconds": None}
    write_report(rows, tmp_path, "command", 1)
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["gap.png"]


@pytest.mark.slow
def test_the_same_rows_give_the_same_bytes(report, tmp_path):
    write_report(CASES["one cell"], tmp_path, "kgs study --preset cpu", 99)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (report("one cell")[0] / path.name).read_bytes()


@pytest.mark.slow
def test_the_main_table(markdown):
    rows = FULL
    for scene, setting in (
        ("llff/fern", "llff/fern, 3 views, dense"),
        ("blender/lego", "blender/lego, 8 views, dense"),
    ):
        views = 8 if scene == "blender/lego" else 3
        off, paper = (psnrs(rows, scene, method, views) for method in MAIN[:2])
        (row,) = lines(markdown, "Test views", setting, "progressive 0.2")
        expected = ["3", f"{np.mean(paper):.2f} ({np.std(paper, ddof=1):.2f})", f"{max(paper):.2f}"]
        assert row[2:5] == expected
        assert row[5] == f"{np.mean(paper) / 110:.3f} ({np.std(paper, ddof=1) / 110:.3f})"
        assert row[6] == f"{np.mean(paper) / 31:.3f} ({np.std(paper, ddof=1) / 31:.3f})"
        assert row[7] == f"{interval(np.subtract(paper, off))} (3)"
        assert row[8] == interval(np.subtract(paper, off) / 110, decimals=3)
    assert "20.76 / 0.713 / 0.200 or 20.56 / 0.708 / 0.207 | +1.54 or +1.34 |" in markdown
    assert "25.42 / 0.888 / 0.089 | +3.86 |" in markdown


@pytest.mark.slow
def test_means_over_scenes(markdown):
    rows = FULL
    scenes = (("llff/fern", 3), ("llff/flower", 3), ("blender/lego", 8))
    off, paper = (np.array([psnrs(rows, name, method, views) for name, views in scenes]) for method in MAIN[:2])
    (row,) = lines(markdown, "Test views", "mean of 3 scenes (fern, flower, lego)", "progressive 0.2")
    assert row[3] == f"{paper.mean():.2f} ({paper.mean(0).std(ddof=1):.2f})"
    assert row[4] == f"{paper.mean(0).max():.2f}"
    differences = paper - off
    half = student(6) * math.sqrt(differences.var(1, ddof=1).mean() / 9)
    mean = differences.mean()
    over = student(2) * differences.mean(1).std(ddof=1) / math.sqrt(3)
    both = f"{mean:+.2f} [{mean - over:+.2f}, {mean + over:+.2f}] over scenes, "
    both += f"[{mean - half:+.2f}, {mean + half:+.2f}] over seeds"
    assert row[7] == f"{both} (9)"
    assert row[9:] == ["-", "-"]  # the paper has no such mean
    (llff,) = lines(markdown, "Test views", "mean of 2 LLFF scenes (fern, flower)", "progressive 0.2")
    assert llff[9:] == ["20.76 / 0.713 / 0.200 or 20.56 / 0.708 / 0.207", "+1.54 or +1.34"]
    (first,) = lines(
        markdown, "Paired differences", "The paper's rule (progressive 0.2) over no dropping (off)", "PSNR [dB]"
    )
    sd = math.sqrt(differences.var(1, ddof=1).mean())
    assert first[2:] == [both, "3", "9", f"{sd:.2f}", *map(interval, differences)]


@pytest.mark.slow
def test_the_tables_of_views_and_of_initial_points(markdown):
    rows = FULL
    six = [psnrs(rows, scene, "off", 6)[0] for scene in ("llff/fern", "llff/flower")]
    (views,) = lines(markdown, "Numbers of views", "llff/fern, 6 views, dense", "off")
    assert views[2:4] == ["1", f"{six[0]:.2f}"]
    (views,) = lines(markdown, "Numbers of views", "mean of 2 scenes (fern, flower), 6 views", "off")
    assert views[2:4] == ["1", f"{np.mean(six):.2f}"]
    assert views[9] == "23.80 / 0.814 / 0.125"
    dense, off = psnrs(rows, "llff/fern", "progressive 0.2"), psnrs(rows, "llff/fern", "off")
    sift = [r["result"]["test"]["psnr"] for r in rows if r["cell"]["start"] == "sift"]
    (start,) = lines(markdown, "Initial points", "llff/fern, 3 views", "dense")
    assert start[8:] == [f"{interval(np.subtract(dense[:2], sift))} (2)", f"{interval(np.subtract(dense, off))} (3)"]
    assert lines(markdown, "Initial points", "model-points (sees test views)")


@pytest.mark.slow
def test_the_tables_of_methods_and_of_costs(markdown):
    rows = FULL
    dense, off, fixed = (psnrs(rows, "llff/fern", name) for name in ("progressive 0.2", "off", "fixed 0.3"))
    (rate,) = lines(markdown, "Rates and schedules", "fixed 0.3")
    assert rate[5:7] == [f"{np.mean(fixed) / d:.3f} ({np.std(fixed, ddof=1) / d:.3f})" for d in (110, 31)]
    for column, values in ((7, off), (9, dense)):
        gains = np.subtract(fixed, values[:2])
        assert rate[column : column + 2] == [f"{interval(gains)} (2)", interval(gains / 110, decimals=3)]
    assert lines(markdown, "Selected Gaussians", "near")[0][11:] == ["17.49 / 0.582 / 0.273", "-1.73", "-3.27"]
    fern = [r["result"] for r in rows if list(r["cell"].values())[:4] == ["llff/fern", 3, "dense", "off"]]
    costs = lines(markdown, "Cost, overfitting", "llff/fern, 3 views, dense")
    assert [row[1] for row in costs] == [*MAIN, *ABLATIONS]  # not in the order of the rows
    gaps = [result["train"]["psnr"] - result["test"]["psnr"] for result in fern]
    adapted = [1e3 * result["coadaptation"] for result in fern]
    assert costs[0][3] == f"{np.mean(gaps):.2f} ({np.std(gaps, ddof=1):.2f})"
    assert costs[0][8] == f"{np.mean(adapted):.2f} ({np.std(adapted, ddof=1):.2f})"
    (scene,) = lines(markdown, "Scenes, splits", "blender/lego, 8 views")
    assert scene[1:] == ["8", "2", "18", "252x189", "drop 0.2, steps 2000"]


@pytest.mark.slow
def test_the_built_in_scene_is_shown_but_counts_in_no_mean(tmp_path):
    rows = [made_up(scene, 3, "dense", method, 0) for scene in ("llff/fern", "synthetic") for method in MAIN[:2]]
    uris = [f"data:image/jpeg;base64,{name}" for name in ("cGhvdG8=", "cmVuZGVy", "ZGlmZg==")]
    rows[2]["result"]["pictures"] = uris
    text = write_report(rows, tmp_path, "command", 4)
    assert "4 of 4 cells" in text
    assert not lines(text, "Test views", "synthetic, 3 views, dense")
    assert (tmp_path / "sparse.csv").read_text().count("synthetic,") == 2
    html = (tmp_path / "index.html").read_text()
    assert re.findall(r'<img[^>]*src="([^"]*)"', html)[-3:] == uris
    psnr = rows[2]["result"]["test"]["psnr"]
    assert f"off:\nPSNR {psnr:.2f} dB, SSIM {psnr / 31:.3f}, LPIPS {psnr / 110:.3f}" in html


@pytest.mark.slow
def test_the_page_can_be_cited_and_its_text_is_escaped(report):
    page = (report("partial")[0] / "index.html").read_text()
    assert f"version = {{{__version__}}}" in page
    for text in ("@software{kgs,", "@inproceedings{park2025dropgaussian,", "arxiv.org/abs/2504.00773", "LICENSE-2.0"):
        assert text in page
    for source in ("bmild.github.io/llff", "NVlabs/instant-ngp"):  # of the scenes
        assert source in page
    assert page.index("over no dropping (off): ") < page.index("<table")
    assert "<b>" not in (report("unknown method, no LPIPS")[0] / "index.html").read_text()


@pytest.mark.slow
def test_commits_and_dates_of_the_cells_are_named(tmp_path):
    rows = [made_up("llff/fern", 3, "dense", "off", seed) for seed in range(3)]
    for row, day in zip(rows[:2], (3, 1), strict=True):
        row["result"] |= {"date": f"2026-12-0{day}", "revision": "1a2b3c4 of 2026-11-30"}
    rows[1]["result"]["versions"] = {"kgs": "0.1.0", "machine": "aarch64, 4 cores"}
    text = write_report(rows, tmp_path, "command", 5)
    assert "Figures: 3 of 5 cells; from 2026-12-01 to 2026-12-03." in text
    assert "2 1a2b3c4 of 2026-11-30; 1 of no known commit" in text
    assert "2 kgs 0.1.0, machine x86_64, 2 cores; 1 kgs 0.1.0, machine aarch64, 4 cores" in text
    with (tmp_path / "sparse.csv").open(newline="") as file:
        found = [(row["revision"], row["versions_machine"]) for row in csv.DictReader(file)]
    assert found == [
        ("1a2b3c4 of 2026-11-30", "x86_64, 2 cores"),
        ("1a2b3c4 of 2026-11-30", "aarch64, 4 cores"),
        ("", "x86_64, 2 cores"),
    ]
