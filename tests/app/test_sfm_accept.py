"""Which cameras are accepted: consensus of two solvers, retries, rejected photos, acceptance checks."""

from concurrent.futures import ThreadPoolExecutor
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from solved_cameras import solved

from kgs.app.sfm import accept
from kgs.app.sfm.accept import (
    MAX_DEGREES,
    Consensus,
    angle_between,
    check,
    doubtful,
    objections,
    retry,
    without_cameras,
)
from kgs.app.sfm.map import NO_CAMERAS
from kgs.errors import PhotosRefused

ALL = "abcdef"
NAMES = {f"{name}.png": name for name in ALL}
MATCHES = {pair: 100 + 10 * i for i, pair in enumerate(combinations(NAMES, 2))}  # most in e and f
CHAIN = dict.fromkeys(pairwise(ALL), 200)
PAIRS = {("a", "b"): 200, ("a", "c"): 40, ("b", "c"): 90}


def cameras(names=ALL, points=90, turned=None, focals=None, **others):
    """Cameras of these photos, which see so many points but for those in `others`."""
    return solved(names, dict.fromkeys(names, points) | others, turned, focals)


def three(focal=800.0, points=(90, 80, 70), turn=0.0, missing="", rise=0.1):
    """Three cameras, the last turned by so many degrees about y."""
    counts = {name: count for name, count in zip("abc", points, strict=True) if name not in missing}
    return solved(counts, counts, {"c": turn}, dict.fromkeys("abc", focal), rise)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (three(focal=399), "0.399 times the longer side"),
        (three(focal=3001), "3 times the longer side"),
        (three(points=(90, 49, 50)), "fewer than 50 points are seen in b (49)"),
        (three(missing="b"), "1 of 3 photos could not be placed: b"),
        (NO_CAMERAS, "no pair of photos"),
    ],
)
def test_what_speaks_against_one_solver(found, said):
    (reason,) = objections(found, list("abc"), 1000)
    assert said in reason


@pytest.mark.parametrize("found", [three(), three(focal=400, points=(50, 50, 50))])
def test_nothing_speaks_against_cameras_within_the_limits(found):
    assert objections(found, list("abc"), 1000) == []


@pytest.mark.parametrize("angle", [1e-6, 0.1, 1.9, 60.0, 179.0])
def test_solvers_differ_by_the_angle_between_relative_rotations(angle):
    assert angle_between(three(), three(turn=angle), ("b", "c")) == pytest.approx(angle, rel=1e-6)


FEW = three(points=(90, 20, 90))
UNSURE = three(rise=0.004)
LESS_UNSURE = three(rise=0.009, points=(99, 99, 99))
SURE = three(rise=0.03)
GIVEN = three(rise=np.inf)
GIVEN_MORE = three(rise=np.inf, points=(99, 99, 99))


@pytest.mark.parametrize(
    ("first", "second", "index", "degrees"),
    [
        (three(), three(turn=1.9, points=(99, 99, 99)), 1, 1.9),  # it sees more points
        (FEW, three(), 1, 0),  # few points are enough to confirm the other
        (GIVEN, GIVEN, 0, 0),
        (GIVEN, GIVEN_MORE, 1, 0),
        (LESS_UNSURE, SURE, 1, 0),  # though it sees fewer points
        (LESS_UNSURE, three(rise=0.03, points=(49, 99, 99)), 0, 0),
        (three(), three(focal=700), 0, 0),
    ],
)
@pytest.mark.parametrize("forward", [False, True])
def test_cameras_that_pass(first, second, index, degrees, forward):
    found = check(Path("photos"), (first, second), list("abc"), 1000, PAIRS, forward=forward)
    assert found == (index, pytest.approx(degrees, abs=1e-5))


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        (three(), three(turn=2.1), "disagree about b and c .*2.1 degrees.* places between b and c"),
        (three(), NO_CAMERAS, "only one could place a, b, c, so that nothing confirms it"),
        (three(), three(missing="c"), "only one could place c, so that nothing confirms it.* places between b and c"),
        (FEW, FEW, "seen in b .20.*places between b and c"),  # the weakest link of the strongest tree
        (UNSURE, LESS_UNSURE, r"grow by 0\.9%, less than 3%.*3 to 20 degrees apart"),
        (three(rise=-1e-9), LESS_UNSURE, r"grow by 0\.9%"),
        (three(rise=np.nan), LESS_UNSURE, r"grow by 0\.9%"),
        (three(), three(focal=690), r"differ by a factor of 1\.16, more than 1\.15.*3 to 20 degrees apart"),
        (three(focal=690), three(), r"differ by a factor of 1\.16"),
        (three(), three(focal=690, turn=3.0), "disagree about .*3 degrees"),  # the graver one first
        (three(focal=3001), three(focal=3001), "3 times the longer side"),
    ],
)
@pytest.mark.parametrize("forward", [False, True])
def test_cameras_that_are_refused(first, second, said, forward):
    with pytest.raises(PhotosRefused) as caught:
        check(Path("photos"), (first, second), list("abc"), 1000, PAIRS, forward=forward)
    reason, advice = str(caught.value).split("What helps")
    assert "Matches of each pair" in advice
    assert ("step sideways, not forward" in advice) == forward
    assert caught.match(f"(?s){said if not forward else said.partition('.*')[0]}")
    if forward:
        assert "places between" not in reason + advice


@pytest.mark.parametrize(
    ("first", "second", "left", "said"),
    [
        (cameras(), cameras(), "", ""),
        (cameras("bcdef"), cameras("bcdef"), "a", "neither of two solvers"),
        (cameras("bcdef"), cameras("abcde"), "af", "only one of two solvers"),
        (cameras(c=49), cameras(c=20), "c", "only 49 points"),
        (cameras(c=49), cameras(), "", ""),  # one solver sees it well, the other confirms it
        (cameras(), cameras(turned={"d": 2 * MAX_DEGREES}), "d", "4 degrees apart"),
        (cameras(), cameras(turned={"d": 40.0, "e": 80.0}), "de", "degrees apart"),
        (cameras(), cameras(turned={"d": 0.9 * MAX_DEGREES}), "", ""),
        (cameras("bcdef"), cameras("bcdef", turned={"d": 40.0}), "a", "neither"),  # d is looked at without a
        (cameras(), cameras(turned={n: 10.0 * i for i, n in enumerate(ALL)}), "", ""),  # no three agree
        (cameras("abcd"), cameras("cdef"), "", ""),  # two would remain
        (cameras(focals={"e": 1200.0}), cameras(focals={"e": 1600.0}), "e", "factor of 1.33 about the focal length"),
        (cameras(focals={"e": 1200.0}), cameras(focals={"e": 1250.0}), "", ""),
        (cameras(), NO_CAMERAS, "", ""),
    ],
)
def test_photos_without_cameras_that_can_be_trusted(first, second, left, said):
    found = without_cameras((first, second), list(ALL), CHAIN)
    assert "".join(sorted(found)) == left
    assert all(said in why for why in found.values())


@pytest.mark.parametrize(("second", "expected"), [(cameras("abc"), ""), (cameras("ab"), "c"), (NO_CAMERAS, "abc")])
def test_photos_are_in_doubt_also_where_none_could_be_left_out(second, expected):
    assert doubtful((cameras("abc"), second), list("abc"), PAIRS) == set(expected)


class Tries:
    """A solver whose tries give the cameras in a list, and the arguments of each of them."""

    database = "matches.db"

    def __init__(self, *found):
        self.found = iter(found)
        self.calls = []

    def solve(self, names, focals=(), **options):
        self.calls.append(options)
        return next(self.found, NO_CAMERAS)


@pytest.fixture(autouse=True)
def matches(monkeypatch):
    found = {pair: ([None] * count, [None] * count) for pair, count in MATCHES.items()}
    monkeypatch.setattr(accept, "verified_matches", lambda database: found)


def test_other_first_pairs_until_all_photos_are_registered():
    whole = cameras(points=60)
    tries = Tries(NO_CAMERAS, cameras("abcd"), whole)
    assert retry(tries, NAMES, (), cameras("abc", points=2), cameras(), set("bde")) is whole
    pairs = [call["first_pair"] for call in tries.calls]
    assert pairs == sorted(pairs, key=MATCHES.__getitem__, reverse=True)
    assert all({"b.png", "d.png", "e.png"} & set(pair) for pair in pairs)
    assert [call["attempt"] for call in tries.calls] == [1, 2, 3]  # other seeds
    assert [call["at_least"] for call in tries.calls] == [1, 1, 5]  # more than the best so far


def test_tries_are_few_and_change_nothing_where_they_find_no_more():
    found = cameras("abcde")
    tries = Tries(cameras("abcde"), cameras("abc", points=500), cameras(f=49, points=80))
    assert retry(tries, NAMES, (), found, NO_CAMERAS, set("f")) is found
    assert len(tries.calls) == 4
    assert retry(Tries(), NAMES, (), NO_CAMERAS, NO_CAMERAS, set(ALL)) is NO_CAMERAS


def test_a_photo_is_registered_by_own_points_beside_the_cameras_of_the_others():
    other, whole = cameras(), cameras(points=70)
    tries = Tries(*[NO_CAMERAS] * 4, whole)
    assert retry(tries, NAMES, (), cameras("abcd", d=20), other, set("ef")) is whole
    start = tries.calls[-1]["start"]
    assert set(start.rotations) == {"a", "b", "c"}  # neither those to register nor the one with few points
    assert start.reconstruction is other.reconstruction
    assert tries.calls[-1]["at_least"] == 4
    tries = Tries()
    retry(tries, NAMES, (), cameras("ab"), cameras("bcdef"), set("acdef"))
    assert not any("start" in call for call in tries.calls)  # one camera holds nothing


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (cameras(), cameras(), []),  # nothing is doubtful
        (cameras(), cameras("abcd"), [1]),
        (NO_CAMERAS, cameras(), [0]),
        (cameras("abc"), cameras("bcd", points=20), [0, 1]),
        (cameras(), cameras(c=20), []),  # it confirms the first one
        (cameras(), cameras(turned={"c": 180.0}), [0, 1]),  # they differ
    ],
)
def test_the_whole_set_first_and_then_those_that_failed_try_again(monkeypatch, first, second, expected):
    asked, better = [], cameras()

    def again(solver, *_):
        asked.append(solvers.index(solver))
        return better

    monkeypatch.setattr(accept, "retry", again)
    solvers = Tries(first), Tries(second)
    with ThreadPoolExecutor(1) as executor:
        matched = executor.submit(lambda: None)
        found, held = Consensus(solvers, matched, executor, [], CHAIN).solve(NAMES)
    assert sorted(asked) == expected
    assert list(map(id, found)) == [id(better) if i in expected else id(c) for i, c in enumerate((first, second))]
    assert held == []
