"""What is not believed of a solver's cameras, and what is said of it."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from solved_cameras import solved

from kgs.app.sfm import map as mapping
from kgs.app.sfm.gates import (
    disagreement,
    groups_of,
    is_forward,
    judge,
    objections,
    table,
    weakest_link,
    why_no_cameras,
)
from kgs.app.sfm.map import PairGeometry
from kgs.errors import PhotosRefused

NAMES = ["a", "b", "c"]
PAIRS = {("a", "b"): 200, ("a", "c"): 40, ("b", "c"): 90}


def cameras(focal=800.0, points=(90, 80, 70), turn=0.0, missing=(), rise=0.1):
    """Three cameras, the last turned by so many degrees about y."""
    counts = {name: count for name, count in zip(NAMES, points, strict=True) if name not in missing}
    return solved(counts, counts, {"c": turn}, dict.fromkeys(NAMES, focal), rise)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (cameras(focal=399), "0.399 times the longer side"),
        (cameras(focal=3001), "3 times the longer side"),
        (cameras(points=(90, 49, 50)), "fewer than 50 points are seen in b (49)"),
        (cameras(missing=("b",)), "1 of 3 photos could not be placed: b"),
        (None, "no pair of photos"),
    ],
)
def test_what_speaks_against_one_solver(found, said):
    (reason,) = objections(found, NAMES, 1000)
    assert said in reason
    assert objections(cameras(), NAMES, 1000) == []
    assert objections(cameras(focal=400, points=(50, 50, 50)), NAMES, 1000) == []


@pytest.mark.parametrize("angle", [1e-6, 0.1, 1.9, 60.0, 179.0])
def test_disagreement_is_the_angle_between_relative_rotations(angle):
    degrees, pair = disagreement(cameras(), cameras(turn=angle))
    assert degrees == pytest.approx(angle, rel=1e-6)
    assert pair == ("b", "c")


def test_two_solvers_have_to_agree(tmp_path):
    first, second = cameras(), cameras(turn=1.9, points=(99, 99, 99))
    assert judge(tmp_path, [first, second], NAMES, 1000, PAIRS) == (1, pytest.approx(1.9))  # it sees more points
    with pytest.raises(PhotosRefused, match="disagree about b and c"):
        judge(tmp_path, [first, cameras(turn=2.1)], NAMES, 1000, PAIRS)
    for other in (None, cameras(missing=("c",))):
        with pytest.raises(PhotosRefused, match=r"only one could place .*c, so that nothing confirms it"):
            judge(tmp_path, [first, other], NAMES, 1000, PAIRS)
    few = cameras(points=(90, 20, 90))  # enough to confirm the other
    assert judge(tmp_path, [few, first], NAMES, 1000, PAIRS)[0] == 1
    with pytest.raises(PhotosRefused, match="places between b and c"):  # the weakest link of the strongest tree
        judge(tmp_path, [few, few], NAMES, 1000, PAIRS)


def test_the_photos_or_their_exif_have_to_tell_the_focal_length(tmp_path):
    first, second, given = cameras(rise=0.004), cameras(rise=0.009, points=(99, 99, 99)), cameras(rise=np.inf)
    for unsure in (first, cameras(rise=-1e-9), cameras(rise=np.nan)):
        with pytest.raises(PhotosRefused, match=r"grow by 0\.9%, less than 3%.*3 to 20 degrees apart"):
            judge(tmp_path, [unsure, second], NAMES, 1000, PAIRS)
    assert judge(tmp_path, [given, given], NAMES, 1000, PAIRS)[0] == 0
    more = given._replace(points=dict.fromkeys(NAMES, 99))  # of the same focal lengths
    assert judge(tmp_path, [given, more], NAMES, 1000, PAIRS)[0] == 1
    sure = cameras(rise=0.03)
    assert judge(tmp_path, [second, sure], NAMES, 1000, PAIRS)[0] == 1  # though it sees fewer points
    few = cameras(rise=0.03, points=(49, 99, 99))
    assert judge(tmp_path, [second, few], NAMES, 1000, PAIRS)[0] == 0


def test_two_solvers_have_to_agree_on_the_focal_length(tmp_path):
    near, far = cameras(focal=700), cameras(focal=690)
    assert judge(tmp_path, [cameras(), near], NAMES, 1000, PAIRS)[0] == 0
    for found in ([cameras(), far], [far, cameras()]):
        with pytest.raises(PhotosRefused, match=r"differ by a factor of 1\.16, more than 1\.15.*3 to 20 degrees apart"):
            judge(tmp_path, found, NAMES, 1000, PAIRS)
    with pytest.raises(PhotosRefused, match="disagree about .*3 degrees.*places between"):  # the graver one first
        judge(tmp_path, [cameras(), cameras(focal=690, turn=3.0)], NAMES, 1000, PAIRS)


def test_groups_links_and_the_table():
    assert groups_of(NAMES, PAIRS) == [["a", "b", "c"]]
    assert groups_of(NAMES, PAIRS | {("a", "c"): 29, ("b", "c"): 29}) == [["a", "b"], ["c"]]
    assert weakest_link(NAMES, PAIRS) == ("b", "c")
    assert weakest_link(NAMES, PAIRS | {("a", "left out"): 300}) == ("b", "c")
    assert [line.split() for line in table(NAMES, PAIRS).splitlines()[2:]] == [
        ["1", "a", ".", "200", "40"],
        ["2", "b", "200", ".", "90"],
        ["3", "c", "40", "90", "."],
    ]


def test_photos_that_can_give_no_cameras():
    deep, flat, same = PairGeometry(30.0, 0.5), PairGeometry(30.0, 0.99), PairGeometry(0.1, 1.0)
    assert why_no_cameras(NAMES, PAIRS, dict.fromkeys(PAIRS, flat) | {("a", "c"): deep}) == ""
    assert "only turned on the spot" in why_no_cameras(NAMES, PAIRS, dict.fromkeys(PAIRS, flat))
    said = why_no_cameras(NAMES, PAIRS, dict.fromkeys(PAIRS, deep) | {("a", "b"): same})
    assert "a and b" in said
    assert "remove one of them" in said
    assert "watermark" in said  # matches at the same pixels can be those of what is printed on the photos
    assert "no two of the 3" in why_no_cameras(NAMES, dict.fromkeys(PAIRS, 0), {})


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
    assert mapping._is_forward(first, second, SimpleNamespace(width=800, height=600)) is expected


def test_no_camera_moves_along_its_view_where_nothing_matches():
    rng = np.random.default_rng(0)
    lens = SimpleNamespace(width=800, height=600)
    for count in (30, 200):
        first, second = rng.uniform(0, 600, (2, count, 2))
        assert not mapping._is_forward(first, second, lens)
    assert not mapping._is_forward(first, first, lens)  # one photo twice
    assert not mapping._is_forward(first[:, :1] * (1, 0), first[:, :1] * (1, 0), lens)  # on one line


def test_what_is_said_of_a_camera_that_went_forward(tmp_path):
    forward, aside, flat = (PairGeometry(30.0, p, f) for p, f in ((0.5, True), (0.5, False), (0.99, False)))
    assert is_forward({("a", "b"): forward, ("b", "c"): forward, ("a", "c"): flat})
    for pairs in ({("a", "b"): forward, ("b", "c"): aside}, {("a", "b"): flat}, {}):
        assert not is_forward(pairs)
    alone, turned = [cameras(), None], [cameras(), cameras(turn=3.0)]
    for found in ([cameras(focal=3001)] * 2, [cameras(rise=0.0)] * 2, turned, alone):
        with pytest.raises(PhotosRefused, match="step sideways, not forward") as caught:
            judge(tmp_path, found, NAMES, 1000, PAIRS, forward=True)
        assert "places between" not in str(caught.value)
        assert "Matches of each pair" in str(caught.value)
    assert judge(tmp_path, [cameras()] * 2, NAMES, 1000, PAIRS, forward=True)[1] == 0  # good cameras are good
