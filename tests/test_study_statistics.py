"""Statistics against closed forms, enumeration and mpmath."""

import math
import random

import numpy as np
import pandas as pd
import pytest
from study_rows import made_up, student

from kgs.bench.output import mean_sd
from kgs.bench.study.published import PUBLISHED, benchmark_of, published, published_difference
from kgs.bench.study.tables import (
    BEST_OF_5,
    Difference,
    Noise,
    cells_frame,
    difference,
    noise_floor,
    paired_difference,
    wide,
)

PAPER = "progressive 0.2"


def columns(*groups):
    """A table with one group per column."""
    return pd.DataFrame({k: pd.Series(values, dtype=float) for k, values in enumerate(groups)})


def test_quantiles_of_student_in_closed_form():
    # one degree of freedom: Cauchy; two: t = a sqrt(2 / (1 - a^2)) for P(|t| < t) = a
    expected = {1: math.tan(math.pi / 2 * 0.95), 2: 0.95 * math.sqrt(2 / (1 - 0.95**2))}
    expected |= {freedom: student(freedom) for freedom in (*range(3, 31), 100, 501)}
    for freedom, quantile in expected.items():
        assert Noise(1.0, freedom, 1).between_means(2) == pytest.approx(quantile, rel=1e-9)


def test_mean_and_deviation_as_text():
    assert mean_sd([20.0, math.nan, 22.0, 24.0], 1) == "22.0 (2.0)"
    assert [mean_sd(values, 1) for values in ([2.0], [math.nan], [])] == ["2.0", "-", "-"]


def test_interval_of_one_scene_is_that_of_a_paired_t_test():
    differences = [0.31, -0.12, 0.44, 0.20, 0.05]
    found = paired_difference(columns(differences))
    half = student(4) * np.std(differences, ddof=1) / math.sqrt(5)
    assert found.pairs == 5
    assert (found.mean, found.low, found.high) == pytest.approx((0.176, 0.176 - half, 0.176 + half))


def test_one_pair_has_no_interval_and_none_no_difference():
    assert paired_difference(columns([0.5]))[:2] == (1, 0.5)
    found = paired_difference(columns([0.5], [], [0.1]))
    assert found[:2] == (2, pytest.approx(0.3))
    assert math.isnan(found.low)
    assert paired_difference(columns([], [])).pairs == paired_difference(pd.DataFrame()).pairs == 0


def test_scenes_weigh_alike_and_share_their_variance():
    found = paired_difference(columns([1.0, 3.0], [10.0, 10.0, 10.0, 10.0], [4.0]))
    # variance between seeds (2 + 0) / (1 + 3); of the mean over scenes a ninth of 1/2 + 1/4 + 1/1 times that
    half = student(4) * math.sqrt(0.5 * 1.75 / 9)
    assert found.pairs == 7
    assert (found.mean, found.low, found.high) == pytest.approx((16 / 3, 16 / 3 - half, 16 / 3 + half))


def test_intervals_over_scenes_hold_as_often_as_they_say():
    rng, held, repeats = random.Random(0), 0, 600
    for _ in range(repeats):
        scenes = [[effect + rng.gauss(0, 0.2) for _ in range(n)] for effect, n in ((0.5, 3), (-0.2, 2), (0.0, 1))]
        found = paired_difference(columns(*scenes))
        held += found.low < 0.1 < found.high
    assert abs(held / repeats - 0.95) < 3 * math.sqrt(0.95 * 0.05 / repeats)


def test_differences_as_text():
    assert Difference(3, 0.314, 0.1, 0.526).text(2) == "+0.31 [+0.10, +0.53]"
    none = (math.nan, math.nan)
    assert [Difference(1, -0.001, *none).text(decimals) for decimals in (2, 3)] == ["+0.00", "-0.001"]
    assert Difference(0, math.nan, *none).text() == "-"


def test_noise_floor():
    found = noise_floor(columns([1.0, 3.0], [5.0], [10.0, 11.0, 12.0], []))
    assert found == Noise(pytest.approx(math.sqrt((2 + 2) / 3)), 3, 2)
    assert found.between_means(1) == pytest.approx(student(3) * math.sqrt(2) * found.sd)
    assert found.between_means(4) == pytest.approx(found.between_means(1) / 2)
    assert noise_floor(columns([1.0], [2.0])).freedom == 0


def test_two_means_differ_by_less_than_the_noise_as_often_as_it_says():
    rng, held, repeats = random.Random(1), 0, 600
    for _ in range(repeats):
        noise = noise_floor(columns(*([rng.gauss(0, 0.2) for _ in range(3)] for _ in range(2))))
        first, second = (sum(rng.gauss(0, 0.2) for _ in range(3)) / 3 for _ in range(2))
        held += abs(first - second) < noise.between_means(3)
    assert abs(held / repeats - 0.95) < 3 * math.sqrt(0.95 * 0.05 / repeats)


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


def test_numbers_that_are_not_there_are_left_out():
    rows = [made_up("s", 3, "dense", "off", seed) for seed in range(4)]
    for row, psnr in zip(rows, (None, 2, math.inf, math.nan), strict=True):
        row["result"]["test"]["psnr"] = psnr
    rows[3]["result"].pop("coadaptation")
    frame = cells_frame(rows)
    assert wide(frame, "test.psnr")["s", 3, "dense", "off"].dropna().to_dict() == {1: 2.0}
    assert frame.coadaptation.count() == 3


def test_two_cells_of_one_seed_are_refused():
    rows = [made_up("s", 3, "sift", "off", seed) for seed in (1, 0)]
    with pytest.raises(ValueError, match="two for 1"):
        cells_frame([*rows, rows[0]])


def test_the_papers_figures():
    assert benchmark_of("llff/fern", 3) == benchmark_of("colmap/trex", 6) == "LLFF"
    assert benchmark_of("blender/lego", 8) == "Blender"
    assert [benchmark_of("colmap/room", views) for views in (3, 24)] == ["LLFF", "Mip-NeRF 360"]
    assert benchmark_of("nerfstudio/fox", 12) is benchmark_of("llff/fern", 12) is None
    assert published("LLFF", 3, PAPER) == "20.76 / 0.713 / 0.200 or 20.56 / 0.708 / 0.207"  # it contradicts itself
    assert published("LLFF", 3, "near") == published("LLFF", 3, "far")
    assert published("LLFF", 6, "fixed 0.1") == published(None, 3, "off") == published("LLFF", 12, "off") == "-"
    assert published_difference("LLFF", 3, PAPER, "off") == "+1.54 or +1.34"
    assert published_difference("Mip-NeRF 360", 24, PAPER, "off") == "+1.33 or +1.12"  # the second from the text
    assert published_difference("LLFF", 3, "fixed 0.1", PAPER) == "-0.28"  # of the same table
    assert published_difference("LLFF", 3, "near", "off") == "-1.73"
    assert published_difference("Blender", 8, PAPER, "off") == "+3.86"
    assert published_difference("Blender", 8, "fixed 0.1", "off") == published_difference(None, 3, PAPER, "off") == "-"
    printed = PUBLISHED
    sums = printed.groupby(["benchmark", "table"])[["psnr", "ssim", "lpips"]].sum()
    assert list(sums.loc["LLFF", "rate and schedule"]) == pytest.approx([141.14, 4.858, 1.502])
    mip = printed[printed.benchmark == "Mip-NeRF 360"][["psnr", "ssim", "lpips"]]
    assert list(mip.sum()) == pytest.approx([109.11, 3.325, 1.522])
    assert printed.psnr.between(15, 30).all()
    assert printed.ssim.between(0.5, 0.9).all()
    assert printed.lpips.between(0.08, 0.42).all()
