"""The published splits, transcribed as tables, and the rule that gives them."""

from __future__ import annotations

import numpy as np
import pytest

from kgs.datasets.options import held_out_between_ends
from kgs.datasets.splits import select_evenly, split_between_ends, split_by_name

# Global positions in the name-sorted list; the strings are the tables of the sparse-view literature.
LLFF = {
    "fern": (20, 3, "1 10 19", "1 4 7 12 15 19", "1 3 5 7 10 12 14 17 19"),
    "flower": (34, 5, "1 17 33", "1 7 13 20 26 33", "1 5 9 12 17 21 25 28 33"),
    "fortress": (42, 6, "1 21 41", "1 9 17 25 33 41", "1 5 11 15 21 26 30 36 41"),
    "horns": (62, 8, "1 30 61", "1 13 25 37 49 61", "1 9 15 23 30 38 46 53 61"),
    "leaves": (26, 4, "1 12 25", "1 5 10 15 20 25", "1 4 6 10 12 15 19 21 25"),
    "orchids": (25, 4, "1 12 23", "1 5 10 14 19 23", "1 3 6 10 12 14 18 21 23"),
    "room": (41, 6, "1 20 39", "1 9 17 23 31 39", "1 5 10 15 20 25 30 35 39"),
    "trex": (55, 7, "1 28 54", "1 11 22 33 44 54", "1 7 14 21 28 34 41 47 54"),
}
MIP360 = [
    ("bicycle", 194, 25, 12, "1 18 36 53 70 87 106 123 140 157 175 193"),
    ("bicycle", 194, 25, 24, "1 9 18 26 34 43 51 59 67 76 84 92 101 109 117 126 134 142 150 159 167 175 185 193"),
    ("bonsai", 292, 37, 12, "1 27 53 79 106 132 159 186 212 238 265 291"),
    ("bonsai", 292, 37, 24, "1 13 26 38 51 63 76 89 101 114 126 139 153 165 178 190 203 215 228 241 253 266 278 291"),
    ("counter", 240, 30, 12, "1 22 44 66 87 109 131 153 174 196 218 239"),
    ("counter", 240, 30, 24, "1 11 21 31 42 52 63 74 84 94 105 115 125 135 146 156 166 177 188 198 209 219 229 239"),
    ("garden", 185, 24, 12, "1 18 34 51 67 84 100 117 133 150 166 183"),
    ("garden", 185, 24, 24, "1 9 17 25 33 41 49 57 65 73 81 89 95 103 111 119 127 135 143 151 159 167 175 183"),
    ("kitchen", 279, 35, 12, "1 26 51 76 101 126 153 178 203 228 253 278"),
    ("kitchen", 279, 35, 24, "1 13 25 37 49 61 73 85 98 109 122 133 146 157 170 181 194 206 218 230 242 254 266 278"),
    ("room", 311, 39, 12, "1 29 57 85 114 141 170 197 226 254 282 310"),
    ("room", 311, 39, 24, "1 14 28 41 54 68 82 94 108 122 135 149 162 175 189 203 217 229 243 257 270 283 297 310"),
    ("stump", 125, 16, 12, "1 12 23 34 45 57 68 79 91 101 113 124"),
    ("stump", 125, 16, 24, "1 6 11 17 22 27 33 38 44 49 54 60 65 70 76 81 86 92 98 102 108 114 118 124"),
]
CASES = MIP360 + [
    (scene, count, tests, views, positions)
    for scene, (count, tests, *rows) in LLFF.items()
    for views, positions in zip((3, 6, 9), rows, strict=True)
]


@pytest.mark.parametrize(("scene", "count", "tests", "views", "positions"), CASES)
def test_published_split(scene: str, count: int, tests: int, views: int, positions: str) -> None:
    train, test = split_by_name([f"{i:04d}" for i in range(count)], views)
    assert train == [int(i) for i in positions.split()]
    assert test == list(range(0, count, 8))
    assert len(test) == tests


def test_names_are_sorted_by_code_point_whatever_their_order() -> None:
    names = [f"img{i}.jpg" for i in (10, 2, 1, 3)]
    train, test = split_by_name(names)
    assert [names[i] for i in test] == ["img1.jpg"]
    assert [names[i] for i in train] == ["img10.jpg", "img2.jpg", "img3.jpg"]


def test_one_view_and_all_views() -> None:
    assert select_evenly(17, 1) == [0]
    assert select_evenly(17, 17) == list(range(17))
    assert select_evenly(17, np.int64(2)) == [0, 16]  # type: ignore[arg-type]  # numpy's integers are none for mypy


@pytest.mark.parametrize("every", [2, 3, 4, 8])
@pytest.mark.parametrize("count", [3, 4, 5, 6, 9, 10, 17])
def test_photos_at_the_ends_of_the_row_are_never_held_out(count: int, every: int) -> None:
    rng = np.random.default_rng(count)
    ranks = rng.permutation(count)  # names in another order than the cameras
    angles = np.linspace(-1, 1, count)[ranks]
    centers = np.stack([np.sin(angles), 0.1 * rng.uniform(-1, 1, count), np.cos(angles)], 1)
    names = [f"IMG_{i:02}.jpg" for i in range(count)]
    train, test = split_between_ends(names, centers, every=every)
    assert sorted([*train, *test]) == list(range(count))
    assert 1 <= len(test) <= max(1, -(-count // every))
    assert not {*test} & {int(ranks.argmin()), int(ranks.argmax())}
    assert [*train] == sorted(train)
    assert len(split_between_ends(names, centers, 2, every)[0]) == 2
    assert len(held_out_between_ends(count - 2, every)) == len(test), "it follows from the number of photos alone"


@pytest.mark.parametrize("every", [2, 3, 4, 7, 8, 50])
def test_more_photos_never_leave_fewer_to_train_on(every: int) -> None:
    left = [count - len(held_out_between_ends(count - 2, every)) for count in range(3, 120)]
    assert left == sorted(left)
    assert left[0] == 2
