"""Lanes of kernels against NumPy."""

import operator

import numpy as np
import pytest

nb = pytest.importorskip("numba")

from kgs._support.compiled import lanes  # noqa: E402  # needs numba
from kgs._support.compiled.kernel import exp2, f32  # noqa: E402
from kgs._support.compiled.lanes import WIDTH, load, store  # noqa: E402

LIMIT = f32(0.5)
ONES = {"floor": np.floor, "ceil": np.ceil, "magnitude": np.abs, "exp2": np.exp2}
TWOS = {
    "add": (operator.add, np.add),
    "sub": (operator.sub, np.subtract),
    "mul": (operator.mul, np.multiply),
    "truediv": (operator.truediv, np.divide),
    "maximum": (lanes.maximum, np.fmax),
    "minimum": (lanes.minimum, np.fmin),
}


def numbers(count, seed=0):
    return np.random.default_rng(seed).normal(0.0, 3.0, count * WIDTH).astype(np.float32)


@pytest.mark.parametrize("name", ONES)
def test_functions_of_lanes_are_numpys(name):
    function = exp2 if name == "exp2" else getattr(lanes, name)
    x = np.concatenate([numbers(3), np.linspace(-126, 126, 4 * WIDTH, dtype=np.float32)])
    out = np.empty_like(x)

    @nb.njit(error_model="numpy")
    def run(x, out):
        for i in range(0, len(x), WIDTH):
            store(out, i, function(load(x, i)))

    run(x, out)
    np.testing.assert_allclose(out, ONES[name](x.astype(np.float64)), rtol=3e-7)


@pytest.mark.parametrize("name", TWOS)
def test_operations_on_lanes_are_numpys(name):
    function, expected = TWOS[name]
    x = numbers(3)
    y = numbers(3, seed=1)
    out = np.empty_like(x)

    @nb.njit(error_model="numpy")
    def run(x, y, out):
        for i in range(0, len(x), WIDTH):
            store(out, i, function(load(x, i), load(y, i)))

    run(x, y, out)
    np.testing.assert_array_equal(out, expected(x, y))


def test_a_formula_of_lanes_is_one_of_numbers_too():
    def formula(x, y):
        return lanes.where_above(x, LIMIT, lanes.root(lanes.magnitude(x)) / y, lanes.maximum(x, y))

    formula = nb.njit(formula)

    @nb.njit(error_model="numpy")
    def run(x, y, wide, single):
        for i in range(0, len(x), WIDTH):
            store(wide, i, formula(load(x, i), load(y, i)))
        for i in range(len(x)):
            single[i] = formula(x[i], y[i])

    x = numbers(2)
    y = numbers(2, seed=1)
    wide, single = np.empty((2, len(x)), np.float32)
    run(x, y, wide, single)
    with np.errstate(all="ignore"):
        expected = np.where(x > LIMIT, np.sqrt(np.abs(x)) / y, np.maximum(x, y))
    np.testing.assert_allclose(wide, expected, rtol=1e-6)
    np.testing.assert_allclose(single, expected, rtol=1e-6)


def test_what_is_not_a_number_becomes_the_other():
    @nb.njit
    def run(x, out):
        store(out, 0, lanes.maximum(load(x, 0), LIMIT))
        store(out, WIDTH, lanes.minimum(load(x, 0), LIMIT))

    out = np.empty(2 * WIDTH, np.float32)
    run(np.full(WIDTH, np.nan, np.float32), out)
    assert (out == LIMIT).all()


def test_lanes_are_chosen_by_a_limit():
    @nb.njit
    def run(x, y, out):
        store(out, 0, lanes.where_above(load(x, 0), LIMIT, load(y, 0), f32(7.0)))
        store(out, WIDTH, lanes.where_at_least(load(x, 0), LIMIT, load(y, 0), f32(7.0)))

    x = numbers(1)
    x[3] = LIMIT
    y = numbers(1, seed=1)
    out = np.empty(2 * WIDTH, np.float32)
    run(x, y, out)
    np.testing.assert_array_equal(out, np.concatenate([np.where(x > LIMIT, y, 7), np.where(x >= LIMIT, y, 7)]))


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


def test_bits_say_which_lanes_are_above_a_limit():
    @nb.njit
    def run(x, limit):
        return lanes.bits_above(load(x, 0), load(limit, 0))

    x, limit = numbers(1), numbers(1, seed=1)
    x[:3] = np.nan, np.inf, limit[2]
    limit[5] = np.nan
    assert run(x, limit) == sum(1 << i for i in range(WIDTH) if x[i] > limit[i])


@pytest.mark.parametrize("bits", [1, 0b1011000, 1 << 31, (1 << 32) - 1, 1 << 62, 0])
def test_the_lowest_and_the_highest_bit(bits):
    @nb.njit
    def run(bits):
        return lanes.lowest(bits), lanes.highest(bits)

    numbers_of_bits = [i for i in range(64) if bits >> i & 1] or [64, -1]
    assert run(bits) == (numbers_of_bits[0], numbers_of_bits[-1])


def test_columns_of_rows():
    @nb.njit
    def run(x, out):
        c = lanes.columns(x, 3)
        store(out, 0, c[0])
        store(out, WIDTH, c[1])
        store(out, 2 * WIDTH, c[4])
        store(out, 3 * WIDTH, c[7])

    x = np.concatenate([np.zeros(3, np.float32), numbers(WIDTH)])
    out = np.empty(4 * WIDTH, np.float32)
    run(x, out)
    np.testing.assert_array_equal(out.reshape(4, WIDTH), x[3:].reshape(WIDTH, WIDTH)[:, [0, 1, 4, 7]].T)
