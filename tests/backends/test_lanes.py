"""Lanes of kernels against NumPy."""

import operator

import numpy as np
import pytest

nb = pytest.importorskip("numba")

from kgs._support.compiled import lanes  # noqa: E402  # needs numba
from kgs._support.compiled.kernel import exp2, f32  # noqa: E402
from kgs._support.compiled.lanes import WIDTH, load, store  # noqa: E402

LIMIT = f32(0.5)
ONES = {
    "floor": (lanes.floor, np.floor),
    "ceil": (lanes.ceil, np.ceil),
    "magnitude": (lanes.magnitude, np.abs),
    "exp2": (exp2, np.exp2),
}
TWOS = {
    "add": (operator.add, np.add),
    "sub": (operator.sub, np.subtract),
    "mul": (operator.mul, np.multiply),
    "truediv": (operator.truediv, np.divide),
    "maximum": (lanes.maximum, np.fmax),
    "minimum": (lanes.minimum, np.fmin),
    "where_above": (
        lambda x, y: lanes.where_above(x, LIMIT, y, f32(7.0)),
        lambda x, y: np.where(x > LIMIT, y, np.float32(7)),
    ),
    "where_at_least": (
        lambda x, y: lanes.where_at_least(x, LIMIT, y, f32(7.0)),
        lambda x, y: np.where(x >= LIMIT, y, np.float32(7)),
    ),
    "root": (
        lambda x, y: lanes.root(lanes.magnitude(x)) / y,
        lambda x, y: np.sqrt(np.abs(x)) / y,
    ),
}


def numbers(count, seed=0):
    return np.random.default_rng(seed).normal(0.0, 3.0, count * WIDTH).astype(np.float32)


def test_functions_of_lanes_are_numpys():
    x = np.concatenate([numbers(3), np.linspace(-126, 126, 4 * WIDTH, dtype=np.float32)])
    out = np.empty_like(x)
    for function, expected in ONES.values():

        @nb.njit(error_model="numpy")
        def run(x, out, function=function):
            for i in range(0, len(x), WIDTH):
                store(out, i, function(load(x, i)))

        run(x, out)
        np.testing.assert_allclose(out, expected(x.astype(np.float64)), rtol=3e-7)


@pytest.mark.parametrize("name", TWOS)
def test_operations_on_lanes_are_numpys_and_those_of_numbers(name):
    function, expected = TWOS[name]
    function = nb.njit(function) if name in ("where_above", "where_at_least", "root") else function

    @nb.njit(error_model="numpy")
    def run(x, y, wide, single):
        for i in range(0, len(x), WIDTH):
            store(wide, i, function(load(x, i), load(y, i)))
        for i in range(len(x)):
            single[i] = function(x[i], y[i])

    x, y = numbers(3), numbers(3, seed=1)
    x[3:5] = LIMIT, np.nan
    wide, single = np.empty_like(x), np.empty_like(x)
    run(x, y, wide, single)
    exact = name != "root"
    np.testing.assert_allclose(wide, expected(x, y), rtol=0 if exact else 3e-7)
    there = ~np.isnan(x)
    np.testing.assert_allclose(single[there], wide[there], rtol=0 if exact else 3e-7)


@pytest.mark.parametrize("count", [1, 11, 16])
def test_totals_add_up_each_of_several_lanes(count):
    text = ", ".join(f"load(x, {i * WIDTH})" for i in range(count))
    space = {"__name__": __name__, "load": load, "store": store, "totals": lanes.totals, "total": lanes.total}
    exec(f"def run(x, out):\n    store(out, 0, totals(({text},)))\n    return total(load(x, 0))", space)
    x = numbers(count)
    out = np.empty(WIDTH, np.float32)
    single = nb.njit(space["run"])(x, out)
    sums = x.reshape(count, WIDTH).sum(1, np.float64)
    np.testing.assert_allclose(out[:count], sums, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(single, sums[0], rtol=1e-5, atol=1e-5)
    assert not out[count:].any()


def test_bits_and_columns():
    @nb.njit
    def run(x, limit, out):
        for i, column in enumerate(lanes.columns(x, 3)):
            store(out, i * WIDTH, column)
        return lanes.bits_above(load(x, 3), load(limit, 0))

    @nb.njit
    def ends(bits):
        return lanes.lowest(bits), lanes.highest(bits)

    x, limit, out = numbers(WIDTH), numbers(1, seed=1), np.empty(8 * WIDTH, np.float32)
    x[:3] = np.nan, np.inf, limit[2]
    limit[5] = np.nan
    behind = np.concatenate([np.zeros(3, np.float32), x])
    assert run(behind, limit, out) == sum(1 << i for i in range(WIDTH) if x[i] > limit[i])
    np.testing.assert_array_equal(out.reshape(8, WIDTH), x.reshape(WIDTH, WIDTH)[:, :8].T)
    for bits in (1, 0b1011000, 1 << 31, (1 << 32) - 1, 1 << 62, 0):
        expected = [i for i in range(64) if bits >> i & 1] or [64, -1]
        assert ends(bits) == (expected[0], expected[-1])
