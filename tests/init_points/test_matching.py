"""The compiled matching of keypoints against torch's: the same pairs, ties included, on any number of threads."""

import pytest
import torch
from kernel_checks import check_bits

from kgs.backends import BACKENDS
from kgs.init_points import matching

pytest.importorskip("numba")


def keypoints(n, m, seed=0):
    """Lines, pixels, and descriptors of which some are nearly those of the other view, and some are there twice."""
    generator = torch.Generator().manual_seed(seed)
    angles = 0.2 * torch.rand(n, generator=generator)
    lines = torch.stack([angles.sin(), angles.cos(), -100 * torch.rand(n, generator=generator)], 1)
    pixels = 100 * torch.rand(m, 2, generator=generator)
    first, second = (
        torch.nn.functional.normalize(torch.rand(k, 128, generator=generator) ** 4, p=1, dim=1).sqrt() for k in (n, m)
    )
    same = min(n, m) // 2
    pixels[:same, 1] = -(lines[:same, 0] * pixels[:same, 0] + lines[:same, 2]) / lines[:same, 1]
    second[:same] = first[:same] + 0.02 * torch.rand(same, 128, generator=generator)
    second[: same // 4], pixels[same : same + same // 4] = second[:1], pixels[: same // 4]
    second[same : same + same // 4] = second[: same // 4]  # equal distances, to the bit
    return lines, pixels, first, second


def matches(arguments, backend):
    return matching.match(*arguments, BACKENDS[backend])


@pytest.mark.parametrize(("n", "m"), [(1, 1), (5, 200), (300, 37), (400, 500), (0, 20), (20, 0), (0, 0)])
def test_matches_are_torchs(n, m):
    arguments = keypoints(n, m)
    (distances, *pairs), (expected, *others) = (matches(arguments, backend) for backend in ("numba", "torch"))
    assert all(torch.equal(a, b) and a.dtype == b.dtype for a, b in zip(pairs, others, strict=True))
    torch.testing.assert_close(distances, expected, rtol=1e-6, atol=1e-7)
    assert len(distances) > 100 or min(n, m) < 400


def test_the_first_of_equal_pairs_has_the_other_as_its_rival(monkeypatch):
    monkeypatch.setattr(matching, "MAX_RATIO", 1.5)
    arguments = (*(x.repeat(2, 1) for x in keypoints(300, 300)[:2]), *(x.repeat(2, 1) for x in keypoints(300, 300)[2:]))
    results, expected = (matches(arguments, backend) for backend in ("numba", "torch"))
    assert len(results[0]) > 50
    assert all(torch.equal(a, b) for a, b in zip(results[1:], expected[1:], strict=True))


def test_bits_do_not_depend_on_threads():
    check_bits(lambda: matches(keypoints(333, 444), "numba"), (1, 2, 3))
