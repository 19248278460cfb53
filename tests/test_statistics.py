"""Statistics against closed forms, enumeration and scipy."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest

from kgs.bench.published import PAPER, TABLES, benchmark_of, published, published_differences
from kgs.bench.statistics import (
    Difference,
    Group,
    Noise,
    average_over_scenes,
    by_seed,
    group_cells,
    noise_floor,
    paired,
    paired_difference,
    student_quantile,
    summarize,
)


def test_quantiles_of_student_in_closed_form():
    # one degree of freedom: Cauchy; two: t = a sqrt(2 / (1 - a^2)) for P(|t| < t) = a
    for a in (0.5, 0.9, 0.95, 0.999):
        assert student_quantile(1, a) == pytest.approx(math.tan(math.pi / 2 * a), rel=1e-12)
        assert student_quantile(2, a) == pytest.approx(a * math.sqrt(2 / (1 - a * a)), rel=1e-12)
    assert student_quantile(2000) == pytest.approx(1.959964, rel=1e-3)
    assert all(a > b for a, b in pairwise(student_quantile(n) for n in range(1, 40)))


def test_quantiles_of_student_against_scipy():
    stats = pytest.importorskip("scipy.stats")
    for freedom in (*range(1, 31), 100, 501):
        for confidence in (0.5, 0.9, 0.95, 0.99):
            expected = stats.t.ppf((1 + confidence) / 2, freedom)
            assert student_quantile(freedom, confidence) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("arguments", "name"), [((0,), "freedom"), ((3, 0.0), "confidence"), ((3, 1.0), "confidence")])
def test_quantiles_outside_their_range_are_refused(arguments, name):
    with pytest.raises(ValueError, match=name):
        student_quantile(*arguments)


def test_summary():
    assert summarize([20.0, 22.0, 24.0]) == (3, 22.0, 2.0, 24.0)
    assert summarize([0.2, 0.1], lower_is_better=True).best == 0.1
    assert summarize([5.0]) == (1, 5.0, None, 5.0)
    assert summarize([]) is None
    assert [summarize(v).text(1) for v in ([1.0, 3.0], [2.0])] == ["2.0 (1.4)", "2.0"]


def test_pairs_are_those_of_the_seeds_that_both_have():
    assert paired({2: 1.0, 0: 5.0, 1: 3.0}, {0: 4.5, 2: 2.0, 7: 0.0}) == [0.5, -1.0]
    assert paired({}, {0: 1.0}) == []


def test_interval_of_one_scene_is_that_of_a_paired_t_test():
    differences = [0.31, -0.12, 0.44, 0.20, 0.05]
    found = paired_difference([differences])
    half = student_quantile(4) * np.std(differences, ddof=1) / math.sqrt(5)
    assert found.pairs == 5
    assert (found.mean, found.low, found.high) == pytest.approx((0.176, 0.176 - half, 0.176 + half))
    stats = pytest.importorskip("scipy.stats")
    interval = stats.ttest_1samp(differences, 0).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx(tuple(interval), rel=1e-10)


def test_one_pair_has_no_interval_and_none_no_difference():
    assert paired_difference([[0.5]]) == (1, 0.5, None, None)
    assert paired_difference([[0.5], [], [0.1]]) == (2, pytest.approx(0.3), None, None)
    assert paired_difference([[], []]) is None


def test_scenes_weigh_alike_and_share_their_variance():
    scenes = [[1.0, 3.0], [10.0, 10.0, 10.0, 10.0], [4.0]]
    found = paired_difference(scenes)
    # variance between seeds (2 + 0) / (1 + 3); of the mean over scenes a ninth of 1/2 + 1/4 + 1/1 times that
    half = student_quantile(4) * math.sqrt(0.5 * 1.75 / 9)
    assert found.pairs == 7
    assert (found.mean, found.low, found.high) == pytest.approx((16 / 3, 16 / 3 - half, 16 / 3 + half))


def test_intervals_over_scenes_hold_as_often_as_they_say():
    rng, held, repeats = random.Random(0), 0, 1500
    for _ in range(repeats):
        scenes = [[effect + rng.gauss(0, 0.2) for _ in range(n)] for effect, n in ((0.5, 3), (-0.2, 2), (0.0, 1))]
        found = paired_difference(scenes)
        held += found.low < 0.1 < found.high
    assert abs(held / repeats - 0.95) < 3 * math.sqrt(0.95 * 0.05 / repeats)


def test_differences_as_text():
    assert Difference(3, 0.314, 0.1, 0.526).text(2) == "+0.31 [+0.10, +0.53]"
    assert [Difference(1, -0.001, None, None).text(decimals) for decimals in (2, 3)] == ["+0.00", "-0.001"]


def test_noise_floor():
    found = noise_floor([[1.0, 3.0], [5.0], [10.0, 11.0, 12.0], []])
    assert found == Noise(pytest.approx(math.sqrt((2 + 2) / 3)), 3, 2)
    assert found.between_means(1) == pytest.approx(student_quantile(3) * math.sqrt(2) * found.sd)
    assert found.between_means(4) == pytest.approx(found.between_means(1) / 2)
    assert noise_floor([[1.0], [2.0]]) is None


def test_two_means_differ_by_less_than_the_noise_as_often_as_it_says():
    rng, held, repeats = random.Random(1), 0, 3000
    for _ in range(repeats):
        noise = noise_floor([[rng.gauss(0, 0.2) for _ in range(3)] for _ in range(2)])
        first, second = (sum(rng.gauss(0, 0.2) for _ in range(3)) / 3 for _ in range(2))
        held += abs(first - second) < noise.between_means(3)
    assert abs(held / repeats - 0.95) < 3 * math.sqrt(0.95 * 0.05 / repeats)


def test_the_best_of_five_normal_numbers():
    draws = np.random.default_rng(0).standard_normal((200_000, 5)).max(1)
    assert Noise(1.0, 1, 1).best_of_five_gain() == pytest.approx(draws.mean(), abs=4 * draws.std() / 200_000**0.5)


def test_average_over_scenes_takes_the_seeds_that_all_have():
    assert average_over_scenes([{0: 1.0, 1: 2.0}, {1: 4.0, 2: 8.0}]) == {1: 3.0}
    assert average_over_scenes([]) == {}


def test_numbers_that_are_not_there_are_left_out():
    results = {1: {"test": {"psnr": 2}}, 0: {"test": {"psnr": None}}, 2: {"test": {}}, 3: {"test": {"psnr": math.nan}}}
    assert by_seed(results, "test.psnr") == {1: 2.0}
    assert by_seed(results, "cpu_seconds.of") == {}


def test_cells_in_groups():
    rows = [
        {"cell": {"scene": "s", "views": 3, "start": "sift", "method": m, "seed": k}, "result": {"k": k}}
        for k in (1, 0)
        for m in ("off", "far")
    ]
    off = Group("s", 3, "sift", "off")
    assert group_cells(rows) == {g: {1: {"k": 1}, 0: {"k": 0}} for g in (off, off._replace(method="far"))}
    with pytest.raises(ValueError, match="two for 1"):
        group_cells([*rows, rows[0]])


def test_the_papers_figures():
    assert benchmark_of("llff/fern", 3) == benchmark_of("colmap/trex", 6) == "LLFF"
    assert benchmark_of("blender/lego", 8) == "Blender"
    assert [benchmark_of("colmap/room", views) for views in (3, 24)] == ["LLFF", "Mip-NeRF 360"]
    assert benchmark_of("nerfstudio/fox", 12) is benchmark_of("llff/fern", 12) is None
    assert [f.psnr for f in published("LLFF", 3, PAPER)] == [20.76, 20.56]  # it contradicts itself
    assert published("LLFF", 3, "near") == published("LLFF", 3, "far")
    assert published("LLFF", 6, "fixed 0.1") == published(None, 3, "off") == published("LLFF", 12, "off") == ()
    assert published_differences("LLFF", 3, PAPER, "off") == (1.54, 1.34)
    assert published_differences("Mip-NeRF 360", 24, PAPER, "off") == (1.33, 1.12)  # the second from the text
    assert published_differences("LLFF", 3, "fixed 0.1", PAPER) == (-0.28,)  # of the same table
    assert published_differences("LLFF", 3, "near", "off") == (-1.73,)
    assert published_differences("Blender", 8, PAPER, "off") == (3.86,)
    assert published_differences("Blender", 8, "fixed 0.1", "off") == published_differences(None, 3, PAPER, "off") == ()
    rates = TABLES["LLFF", 3]["rate and schedule"].values()
    assert [sum(column) for column in zip(*rates, strict=True)] == pytest.approx([141.14, 4.858, 1.502])
    for (benchmark, _), tables in TABLES.items():
        most = 0.42 if benchmark == "Mip-NeRF 360" else 0.3
        figures = [figure for table in tables.values() for figure in table.values()]
        assert all(15 < f.psnr < 30 and 0.5 < f.ssim < 0.9 and 0.08 < f.lpips < most for f in figures)
    rows = [f for views in (12, 24) for table in TABLES["Mip-NeRF 360", views].values() for f in table.values()]
    assert [sum(column) for column in zip(*rows, strict=True)] == pytest.approx([109.11, 3.325, 1.522])
