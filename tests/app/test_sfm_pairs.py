"""What verified matches say: which photos hold together, which show depth, and what to photograph next."""

import re
from itertools import pairwise

import cv2
import numpy as np
import pytest

from kgs.app.sfm.pairs import (
    PairGeometry,
    gap,
    groups_of,
    is_forward,
    table,
    weakest_link,
    went_forward,
    why_no_cameras,
    without_overlap,
)

NAMES = list("abcdef")
CHAIN = dict.fromkeys(pairwise(NAMES), 200)
PAIRS = {("a", "b"): 200, ("a", "c"): 40, ("b", "c"): 90}  # of the first three
DEEP, FLAT, SAME = PairGeometry(30.0, 0.5), PairGeometry(30.0, 0.99), PairGeometry(0.4, 1.0)
ALL_DEEP = dict.fromkeys(CHAIN, DEEP)


@pytest.mark.parametrize(
    ("names", "pairs", "geometries", "left", "said"),
    [
        ("abcdef", CHAIN, ALL_DEEP, "", ""),
        ("abcdef", CHAIN | {("e", "f"): 29}, ALL_DEEP, "f", "at most 29 matches with the others; .*between e and f"),
        ("abcdef", CHAIN | {("a", "b"): 0}, ALL_DEEP, "a", "shows nothing that the others show"),
        ("abcdef", CHAIN | {("a", "c"): 200}, ALL_DEEP | {("a", "b"): SAME}, "b", "same from the same place as a"),
        ("abcdef", CHAIN | {("c", "d"): 0}, ALL_DEEP, "", ""),  # no group is larger than the other
        ("abcde", CHAIN | {("c", "d"): 0}, ALL_DEEP, "de", "nothing that the others show"),
        ("abcdef", CHAIN, dict.fromkeys(CHAIN, SAME), "", ""),  # a watermark: fewer than three would remain
    ],
)
def test_photos_that_cannot_help(names, pairs, geometries, left, said):
    inside = {pair: count for pair, count in pairs.items() if set(pair) <= set(names)}
    found = without_overlap(list(names), inside, geometries)
    assert "".join(found) == left
    assert all(re.search(said, why) for why in found.values())


@pytest.mark.parametrize(
    ("geometries", "pairs", "said"),
    [
        (dict.fromkeys(PAIRS, FLAT) | {("a", "c"): DEEP}, PAIRS, "^$"),
        (dict.fromkeys(PAIRS, FLAT), PAIRS, "only turned on the spot"),
        # matches at the same pixels can be those of what is printed on the photos
        (dict.fromkeys(PAIRS, DEEP) | {("a", "b"): SAME}, PAIRS, "a and b match .* remove one of them.* watermark"),
        ({}, dict.fromkeys(PAIRS, 0), "no two of the 3"),
        ({("a", "b"): DEEP}, PAIRS | {("a", "c"): 9, ("b", "c"): 8}, "2 groups .*1: a, b; 2: c.* between a and c"),
    ],
)
def test_why_matches_give_no_cameras(geometries, pairs, said):
    text = why_no_cameras(NAMES[:3], pairs, geometries)
    assert re.search(said, text, re.DOTALL)
    assert all(len(line) <= 120 for line in text.splitlines())


def test_groups_links_and_the_table():
    assert groups_of(NAMES[:3], PAIRS) == [["a", "b", "c"]]
    assert groups_of(NAMES[:3], PAIRS | {("left", "out"): 500}) == [["a", "b", "c"]]
    assert groups_of(NAMES[:3], PAIRS | {("a", "c"): 29, ("b", "c"): 29}) == [["a", "b"], ["c"]]
    assert weakest_link(NAMES[:3], PAIRS) == ("b", "c")
    assert weakest_link(NAMES[:3], PAIRS | {("a", "left out"): 300}) == ("b", "c")
    assert [line.split() for line in table(NAMES[:3], PAIRS).splitlines()[1:]] == [
        ["1", "2", "3"],
        ["1", "a", ".", "200", "40"],
        ["2", "b", "200", ".", "90"],
        ["3", "c", "40", "90", "."],
    ]


@pytest.mark.parametrize(
    ("name", "others", "pairs", "between"),
    [
        ("f", "abcde", CHAIN, "ef"),
        ("a", "bcdef", CHAIN, "ab"),
        ("c", "abd", {("a", "c"): 20}, "ac"),  # most matches
        ("c", "abe", {}, "bc"),  # next to it in the order in which they were taken
    ],
)
def test_the_gap_is_beside_the_photo_that_was_not_registered(name, others, pairs, between):
    assert gap(name, list(others), pairs) == tuple(between)


@pytest.mark.parametrize(
    ("step", "turn", "expected"),
    [
        ((0.0, 0.0, 0.5), 0.0, True),
        ((0.0, 0.0, -0.5), 0.0, True),  # backward
        ((0.05, -0.03, 0.5), 0.1, True),  # by hand, with a turn
        ((0.5, 0.0, 0.0), 0.0, False),
        ((0.0, 0.4, 0.1), -0.1, False),
        ((0.5, 0.0, 0.5), 0.05, False),  # slanting: a good step
    ],
)
def test_a_camera_that_moves_along_its_view(step, turn, expected):
    """Points before two cameras of 90 degrees, with half a pixel of noise."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2, 3), (3, 2, 9), (400, 3))
    moved = (points - step) @ cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0].T
    first, second = (400 * p[:, :2] / p[:, 2:] + (400, 300) + rng.normal(0, 0.5, (400, 2)) for p in (points, moved))
    assert is_forward(first, second, (800, 600)) is expected


def test_no_camera_moves_along_its_view_where_nothing_matches():
    rng = np.random.default_rng(0)
    few, many = (rng.uniform(0, 600, (2, count, 2)) for count in (30, 200))
    line = many[0][:, :1] * (1, 0)
    for first, second in (few, many, (many[0], many[0]), (line, line)):
        assert not is_forward(first, second, (800, 600))


def test_a_camera_went_forward_where_every_pair_with_depth_says_so():
    forward = PairGeometry(30.0, 0.5, forward=True)
    assert went_forward({("a", "b"): forward, ("b", "c"): forward, ("a", "c"): FLAT})
    for pairs in ({("a", "b"): forward, ("b", "c"): DEEP}, {("a", "b"): FLAT}, {}):
        assert not went_forward(pairs)
