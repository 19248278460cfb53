"""Before photos are left out, the solver that failed looks again, and is judged by what it sees itself."""

from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from solved_cameras import solved

from kgs.app.sfm import agree, second_look
from kgs.app.sfm.leave_out import doubtful
from kgs.app.sfm.second_look import look_again

PHOTOS = list("abcdef")
NAMES = {f"{name}.png": name for name in PHOTOS}
MATCHES = {pair: 100 + 10 * i for i, pair in enumerate(combinations(NAMES, 2))}  # most in e and f


def cameras(photos=PHOTOS, points=90, **others):
    """Cameras of these photos, which see so many points but for those in `others`."""
    return solved(photos, dict.fromkeys(photos, points) | others)


@pytest.fixture
def look(monkeypatch):
    """A second look whose tries give the cameras in a list, and the arguments of each of them."""

    def look(found, other, photos, tries):
        calls = []

        def solve(*arguments, **options):
            calls.append({"seed": arguments[3], **options})
            return tries[len(calls) - 1] if len(calls) <= len(tries) else None

        monkeypatch.setattr(second_look, "solve", solve)
        monkeypatch.setattr(second_look, "verified", lambda database, names: MATCHES)
        arguments = Path("matches.db"), Path("images"), Path("work"), 5, NAMES, ()
        return look_again(*arguments, found, other, set(photos)), calls

    return look


def test_other_first_pairs_until_all_photos_are_registered(look):
    whole = cameras(points=60)
    best, calls = look(cameras("abc", points=2), cameras(), "bde", [None, cameras("abcd"), whole])
    assert best is whole
    pairs = [call["first_pair"] for call in calls]
    assert pairs == sorted(pairs, key=MATCHES.__getitem__, reverse=True)
    assert all({"b.png", "d.png", "e.png"} & set(pair) for pair in pairs)
    assert len({call["seed"] for call in calls} | {5}) == 4
    assert [call["min_registered"] for call in calls] == [1, 1, 5]  # a try has to register more than the best so far


def test_tries_are_few_and_change_nothing_where_they_find_no_more(look):
    found = cameras("abcde")
    best, calls = look(found, None, "f", [cameras("abcde"), cameras("abc", points=500), cameras(f=49, points=80)])
    assert best is found
    assert len(calls) == 4
    assert look(None, None, PHOTOS, [])[0] is None


def test_what_a_solver_sees_itself_decides_where_the_two_differ(look):
    found, richer = cameras(), cameras(points=91)
    best, calls = look(found, cameras(), "c", [cameras(), richer, cameras(points=89)])
    assert best is richer
    assert [call for call in calls if "first_pair" in call] == calls[:4]


def test_a_photo_is_registered_by_own_points_beside_the_cameras_of_the_others(look):
    other = cameras()
    whole = cameras(points=70)
    best, calls = look(cameras("abcd", d=20), other, "ef", [None, None, None, None, whole])
    assert best is whole
    start = calls[-1]["start"]
    assert set(start.rotations) == {"a", "b", "c"}  # neither those to register nor the one with few points
    assert start.reconstruction is other.reconstruction
    assert calls[-1]["min_registered"] == 4
    _, calls = look(cameras("ab"), cameras("bcdef"), "acdef", [])
    assert not any("start" in call for call in calls)  # one camera holds nothing


def test_photos_that_get_a_second_look_where_none_could_be_left_out():
    pairs = dict.fromkeys(combinations(PHOTOS[:3], 2), 200)
    assert doubtful([cameras("abc"), cameras("abc")], list("abc"), pairs) == set()
    assert doubtful([cameras("abc"), cameras("ab")], list("abc"), pairs) == {"c"}
    assert doubtful([cameras("abc"), None], list("abc"), pairs) == set("abc")


def test_the_whole_set_first_and_then_those_that_failed_look_again(monkeypatch):
    """No second look where nothing is doubtful; of one solver where it failed; of both where they differ."""
    solutions = {}
    asked = []

    def look_again(database, *_):
        asked.append(database)
        return cameras()

    monkeypatch.setattr(agree, "solve", lambda database, *_: solutions[database])
    monkeypatch.setattr(agree, "look_again", look_again)
    pairs = {tuple(Path(image).stem for image in pair): 200 for pair in MATCHES}
    turned = cameras()
    turned.rotations["c"] = np.diag([-1.0, 1.0, -1.0])
    cases = [
        (cameras(), cameras(), []),
        (cameras(), cameras("abcd"), ["second"]),
        (None, cameras(), ["first"]),
        (cameras("abc"), cameras("bcd", points=20), ["first", "second"]),
        (cameras(), cameras(c=20), []),  # it confirms the first one
        (cameras(), turned, ["first", "second"]),
    ]
    with ThreadPoolExecutor(1) as executor:
        matched = executor.submit(lambda: None)
        solvers = agree._Solvers(("first", "second"), matched, Path(), Path(), 0, [None], executor, pairs)
        for first, second, expected in cases:
            solutions.update(first=first, second=second)
            asked.clear()
            found, held = solvers.solve(NAMES)
            assert sorted(asked) == expected
            assert [a is b for a, b in zip(found, (first, second), strict=True)] == [
                solver not in expected for solver in ("first", "second")
            ]
            assert held == []
