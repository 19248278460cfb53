"""Statistics against closed forms, SciPy and enumeration."""

import math

import numpy as np
import pandas as pd
import pytest
from study_rows import MAIN, made_up, psnrs, student

from kgs.bench.output import mean_sd
from kgs.study.findings import findings, headline
from kgs.study.pairs import Difference, Noise, cells_frame, difference, main_cells, noise_floor, paired_difference, wide
from kgs.study.published import benchmark_of, published, published_difference
from kgs.study.tables import BEST_OF_5, sparse_tables
from kgs.study.texts import counts, document, table_of

PAPER = "progressive 0.2"


def columns(*groups):
    """A table with one group per column."""
    return pd.DataFrame({k: pd.Series(values, dtype=float) for k, values in enumerate(groups)})


def test_noise_is_pooled_and_two_means_differ_by_a_quantile_of_student():
    found = noise_floor(columns([1.0, 3.0], [5.0], [10.0, 11.0, 12.0], []))
    assert found == Noise(pytest.approx(math.sqrt((2 + 2) / 3)), 3, 2)
    assert found.between_means(4) == pytest.approx(student(3) * math.sqrt(1 / 2) * found.sd)
    assert noise_floor(columns([1.0], [2.0])).freedom == 0
    # one degree of freedom: Cauchy; two: t = a sqrt(2 / (1 - a^2)) for P(|t| < t) = a
    for freedom, quantile in ((1, math.tan(math.pi / 2 * 0.95)), (2, 0.95 * math.sqrt(2 / (1 - 0.95**2)))):
        assert Noise(1.0, freedom, 1).between_means(2) == pytest.approx(quantile, rel=1e-9)


ONE = [0.31, -0.12, 0.44, 0.20, 0.05]
NONE = math.nan


@pytest.mark.parametrize(
    ("groups", "pairs", "mean", "over_seeds", "over_scenes"),  # half of the intervals
    [
        ([ONE], 5, 0.176, student(4) * np.std(ONE, ddof=1) / math.sqrt(5), NONE),
        ([ONE[:3], []], 3, 0.21, student(2) * np.std(ONE[:3], ddof=1) / math.sqrt(3), NONE),
        ([[0.5]], 1, 0.5, NONE, NONE),
        ([[0.5], [], [0.1]], 2, 0.3, NONE, 0.2 * student(1)),
        # variance between seeds (2 + 0) / (1 + 3); of the mean over scenes a ninth of 1/2 + 1/4 + 1/1 times that
        (
            [[1.0, 3.0], [10.0, 10.0, 10.0, 10.0], [4.0], []],
            7,
            16 / 3,
            student(4) * math.sqrt(0.5 * 1.75 / 9),
            student(2) * np.std([2.0, 10.0, 4.0], ddof=1) / math.sqrt(3),
        ),
        # two scenes: Cauchy's quantile, and half of their distance
        ([[0.0, 0.2], [0.3]], 3, 0.2, student(1) * math.sqrt(0.02 * 1.5 / 4), 0.1 * math.tan(math.pi / 2 * 0.95)),
    ],
    ids=["a paired t-test", "a scene without pairs", "one pair", "no seeds", "scenes weigh alike", "two scenes"],
)
def test_a_paired_difference_has_the_intervals_of_two_t_tests(groups, pairs, mean, over_seeds, over_scenes):
    found = paired_difference(columns(*groups))
    scenes = sum(map(bool, groups))
    assert (found.pairs, found.scenes, found.mean) == (pairs, scenes, pytest.approx(mean))
    expected = (mean - over_seeds, mean + over_seeds, mean - over_scenes, mean + over_scenes)
    assert (found.low, found.high, *found.over_scenes) == pytest.approx(expected, nan_ok=True)
    assert ("over scenes" in found.text(labels=True)) == (scenes > 1)


def test_without_pairs_there_is_no_difference():
    for nothing in (columns([], []), pd.DataFrame()):
        found = paired_difference(nothing)
        assert (found.pairs, found.scenes, found.text()) == (0, 0, "-")
        assert math.isnan(found.mean)


UNKNOWN = (NONE, NONE)
SEVERAL = Difference(6, 0.3, 0.2, 0.4, 0.1, 2, (-1.0, 1.6))


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (Difference(3, 0.314, 0.1, 0.526).text(2), "+0.31 [+0.10, +0.53]"),
        (Difference(1, -0.001, *UNKNOWN).text(2), "+0.00"),
        (Difference(1, -0.001, *UNKNOWN).text(3), "-0.001"),
        (Difference(0, NONE, *UNKNOWN).text(), "-"),
        (SEVERAL.text(1), "+0.3 [-1.0, +1.6] over scenes, [+0.2, +0.4] over seeds"),
        (SEVERAL._replace(low=NONE).text(1), "+0.3 [-1.0, +1.6] over scenes"),
        (Difference(3, 0.3, 0.2, 0.4).text(1, labels=True), "+0.3 [+0.2, +0.4] over seeds"),
        (mean_sd([20.0, NONE, 22.0, 24.0], 1), "22.0 (2.0)"),
        (mean_sd([2.0], 1), "2.0"),
        (mean_sd([NONE], 1), "-"),
        (mean_sd([], 1), "-"),
        (counts("cabbb"), "3 b; 1 c; 1 a"),
        (
            document("T", ["s"], {"t": table_of([{"a": "1", "b": "-"}, {"a": "2", "c": "3"}])}),
            "# T\n\n- s\n\nt:\n\n| a | c |\n| --- | --- |\n| 1 | - |\n| 2 | 3 |\n\n",
        ),
    ],
)
def test_numbers_and_tables_as_text(found, expected):
    assert found == expected


def test_the_best_of_five_normal_numbers():
    draws = np.random.default_rng(0).standard_normal((200_000, 5)).max(1)
    assert pytest.approx(draws.mean(), abs=4 * draws.std() / 200_000**0.5) == BEST_OF_5


def test_pairs_are_those_of_the_seeds_that_both_have():
    rows = [made_up("llff/fern", 3, "dense", "off", seed) for seed in (2, 0, 1)]
    rows += [made_up("llff/fern", 3, "dense", "far", seed) for seed in (0, 2, 7)]
    for row, psnr in zip(rows, (1.0, 5.0, 3.0, 4.5, 2.0, 0.0), strict=True):
        row["result"]["test"]["psnr"] = psnr
    frame = cells_frame(rows)
    assert difference(frame, "method", "off", "far")[:2] == (2, pytest.approx((0.5 - 1.0) / 2))
    assert difference(frame, "method", "off", "near").pairs == difference(frame, "method", "off", "off").pairs == 0


def cells_of(psnrs):
    """Made-up cells with these test PSNRs by (scene, views, method), a seed each, and a tenth of them as LPIPS."""
    rows = []
    for (scene, views, method), values in psnrs.items():
        for seed, value in enumerate(values):
            rows.append(made_up(scene, views, "dense", method, seed))
            rows[-1]["result"]["test"] |= {"psnr": value, "lpips_vgg_unscaled": value / 10}
    return cells_frame(rows)


def test_the_main_setting_is_the_studys_number_of_views_where_it_is_there():
    views = {"nerfstudio/fox": (6, 12), "llff/fern": (6, 9, 3), "colmap/trex": (24, 12), "another/scene": (9, 5)}
    frame = cells_of({(scene, n, "off"): [20.0] for scene, counts in views.items() for n in counts})
    main = main_cells(frame)
    expected = {"nerfstudio/fox": 12, "llff/fern": 3, "colmap/trex": 12, "another/scene": 5}
    assert dict(zip(main.scene, main.views, strict=True)) == expected


SCENES = {
    ("llff/fern", 3, "off"): [20.0, 21.0],
    ("llff/fern", 3, MAIN[1]): [21.0, 22.5],
    ("llff/fern", 3, "auto"): [22.012, 23.0],
    ("llff/fern", 3, "auto, off"): [21.5, 22.7],
    ("nerfstudio/fox", 12, "off"): [20.5, 20.1],
    ("nerfstudio/fox", 12, MAIN[1]): [21.9, 22.3],
    ("nerfstudio/fox", 12, "auto"): [21.54, 21.7],
    ("nerfstudio/fox", 6, MAIN[1]): [1.0, 2.0],
    ("nerfstudio/fox", 6, "auto"): [7.0, 9.0],
}


@pytest.fixture(scope="module")
def frame():
    return cells_of(SCENES)


@pytest.fixture(scope="module")
def sentences(frame):
    return findings(frame)


def test_the_headline_has_both_intervals_of_psnr_and_lpips(frame, sentences):
    lines = {(line[""], line["measure"]): line for line in headline(frame)}
    what = "The default (auto) over the paper's rule (progressive 0.2)"
    differences = np.array([[1.012, 0.5], [-0.36, -0.6]])  # fern, fox
    means = differences.mean(1)
    over_scenes = student(1) * means.std(ddof=1) / math.sqrt(2)
    over_seeds = student(2) * math.sqrt(differences.var(1, ddof=1).mean() / 4)
    for measure, factor, decimals in (("PSNR [dB]", 1, 2), ("LPIPS (less is better)", 0.1, 3)):
        line = lines[what, measure]
        ends = (factor * (means.mean() + sign * half) for half in (over_scenes, over_seeds) for sign in (-1, 1))
        a, b, c, d = (f"{end:+.{decimals}f}" for end in ends)
        mean = f"{factor * means.mean():+.{decimals}f}"
        assert line["mean and 95 % intervals"] == f"{mean} [{a}, {b}] over scenes, [{c}, {d}] over seeds"
        assert (line["scenes"], line["pairs"]) == ("2", "4")
        assert line["llff/fern"].startswith(f"{factor * means[0]:+.{decimals}f} [")
        assert line["nerfstudio/fox"].startswith(f"{factor * means[1]:+.{decimals}f} [")
        sentence = next(text for text in sentences if text.startswith(what))
        assert f"{measure} {mean} [{a}, {b}] over scenes, [{c}, {d}] over seeds" in sentence
    only = lines["Dropping in the default (auto over auto, off)", "PSNR [dB]"]
    half = student(1) * np.std([0.512, 0.3], ddof=1) / math.sqrt(2)
    assert only["mean and 95 % intervals"] == f"+0.41 [{0.406 - half:+.2f}, {0.406 + half:+.2f}] over seeds"
    assert (only["scenes"], only["nerfstudio/fox"]) == ("1", "-")


@pytest.mark.slow
def test_the_default_stands_beside_the_others():
    """On each scene that has it; the means are over the scenes that a method has."""
    settings = [("llff/fern", 3), ("nerfstudio/fox", 12), ("nerfstudio/fox", 6)]
    cells = [(*setting, method) for setting in settings for method in (*MAIN, "auto", "auto, off")]
    cells += [("blender/lego", 8, method) for method in MAIN]
    rows = [made_up(*cell[:2], "dense", cell[2], seed) for cell in cells for seed in range(2)]
    tables = sparse_tables(cells_frame(rows))
    main = next(table for title, table in tables.items() if title.startswith("Test views"))
    methods = {scene: [*lines.method] for scene, lines in main.groupby("scene")}
    assert methods["llff/fern, 3 views, dense"] == [*MAIN, "auto", "auto, off"]
    assert methods["mean of 3 scenes (fern, fox, lego)"] == [*MAIN]
    assert methods["mean of 2 scenes (fern, fox)"] == ["auto", "auto, off"]
    default = tables["The default, with and without dropping"].query("method == 'auto'").set_index("scene")
    assert {f"{scene}, {n} views, dense" for scene, n in settings} | {"mean of 2 scenes (fern, fox)"} == {
        *default.index
    }
    auto, paper = (psnrs(rows, "nerfstudio/fox", method, 6) for method in ("auto", PAPER))
    gain = np.subtract(auto, paper).mean()
    assert default[f"over {PAPER} [dB] (pairs)"]["nerfstudio/fox, 6 views, dense"].startswith(f"{gain:+.2f} [")


def test_numbers_that_are_not_there_are_left_out():
    rows = [made_up("s", 3, "dense", "off", seed) for seed in range(4)]
    for row, psnr in zip(rows, (None, 2, math.inf, math.nan), strict=True):
        row["result"]["test"]["psnr"] = psnr
    rows[3]["result"].pop("coadaptation")
    frame = cells_frame(rows)
    assert wide(frame, "test.psnr")["s", 3, "dense", "off"].dropna().to_dict() == {1: 2.0}
    assert frame.coadaptation.count() == 3


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (benchmark_of("llff/fern", 3), "LLFF"),
        (benchmark_of("colmap/room", 3), "LLFF"),
        (benchmark_of("colmap/room", 24), "Mip-NeRF 360"),
        (benchmark_of("blender/lego", 8), "Blender"),
        (benchmark_of("nerfstudio/fox", 12), None),
        (benchmark_of("llff/fern", 12), None),
        (published("LLFF", 3, PAPER), "20.76 / 0.713 / 0.200 or 20.56 / 0.708 / 0.207"),  # it contradicts itself
        (published("LLFF", 6, "fixed 0.1"), "-"),
        (published(None, 3, "off"), "-"),
        (published_difference("Mip-NeRF 360", 24, PAPER, "off"), "+1.33 or +1.12"),  # the second from the text
        (published_difference("LLFF", 3, "fixed 0.1", PAPER), "-0.28"),  # of the same table
        (published_difference("Blender", 8, "fixed 0.1", "off"), "-"),
        (published_difference(None, 3, PAPER, "off"), "-"),
    ],
)
def test_the_papers_figures(found, expected):
    assert found == expected
