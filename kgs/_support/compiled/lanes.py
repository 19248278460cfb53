"""Sixteen float32 numbers as one value of a kernel, on which operators act at once.

Where a loop over pixels is left to the compiler, it takes vectors of half the width that the processor has, keeps in
memory what runs through the loop, and adds up each sum by itself. Kernels that spend their time on pixels say what they
want. `Lanes` are one register with AVX-512, two with AVX2 and four with NEON, and `totals` adds up sixteen of them in
the operations of four.

Lanes have +, -, * and / with each other and with float32. As in all kernels numbers may be rounded together, and x / y
may be x times 1 / y (`_FLAGS`). The functions take lanes, numbers, or both, so that a formula may be written once for
one Gaussian and for sixteen.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import models, register_model

WIDTH = 16
ROW = 16  # numbers of a row of memory, a cache line
intrinsic: Any = extending.intrinsic  # it is typed as if kernels passed the typing context
_FLAGS = ("reassoc", "contract", "nsz", "arcp")


_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)
_FIRST = ir.Constant(ir.IntType(32), 0)


class Lanes(types.Type):
    """The type of sixteen float32."""

    def __init__(self) -> None:
        super().__init__("Lanes")


lanes = Lanes()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _FLOATS)


class _Operation(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        """Two lanes, or lanes and a number, which is the same in all of them."""
        if kws or lanes not in args or any(x not in (lanes, types.float32) for x in args):
            return None
        return signature(lanes, lanes, lanes)


def _define(function: Callable[..., Any], name: str) -> None:
    infer_global(function)(type(f"_{name}", (_Operation,), {}))

    @lower_builtin(function, Lanes, Lanes)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, name)(
            *args, flags=_FLAGS if name != "fdiv" else ()
        )  # 1 / y may overflow where x / y is 1


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")
_define(operator.truediv, "fdiv")


@lower_cast(types.float32, Lanes)
def _spread(context: Any, builder: Any, fromty: Any, toty: Any, value: Any) -> Any:
    nothing = ir.Constant(_FLOATS, ir.Undefined)
    return _shuffle(builder, builder.insert_element(nothing, value, _FIRST), nothing, [0] * WIDTH)


def _shuffle(builder: Any, x: Any, y: Any, order: list[int]) -> Any:
    """Lanes with the numbers of x and y at these positions; those of y count on from those of x."""
    return builder.shuffle_vector(x, y, ir.Constant(_INTS, order))


def _llvm(builder: Any, name: str, *args: Any) -> Any:
    """Call a function of LLVM on lanes, or on numbers."""
    kind = args[0].type
    suffix = f"v{WIDTH}f32" if kind == _FLOATS else "f32"
    function = ir.FunctionType(kind, [kind] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.{suffix}"), args)


def _compare(comparison: str, builder: Any, x: Any, y: Any) -> Any:
    return builder.fcmp_ordered(comparison, x, y, flags=_FLAGS)


def _pointer(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Where the numbers of an array `args[0]` begin, from position `args[1]` on."""
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


@intrinsic
def load(typingctx: Any, array: Any, first: Any) -> Any:
    """Sixteen numbers of a contiguous float32 array `(n,)`, from position `first` on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig, args))
        value.align = 4
        return value

    return lanes(array, first), generate


@intrinsic
def store(typingctx: Any, array: Any, first: Any, value: Any) -> Any:
    """Write lanes to a contiguous float32 array `(n,)`, from position `first` on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        instruction = builder.store(args[2], _pointer(context, builder, sig, args))
        instruction.align = 4
        return context.get_dummy_value()

    return types.none(array, first, lanes), generate


def _function(generate: Callable[..., Any]) -> Any:
    """A function of up to four lanes or numbers: lanes where one is; `generate` gets the builder and the values."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return generate(builder, *args)

    def typed(*args: Any) -> Any:
        kind = lanes if lanes in args else types.float32
        return kind(*[kind] * len(args)), lower

    count = generate.__code__.co_argcount - 1
    kinds = {
        1: lambda typingctx, x: typed(x),
        2: lambda typingctx, x, y: typed(x, y),
        3: lambda typingctx, x, y, z: typed(x, y, z),
        4: lambda typingctx, x, y, z, w: typed(x, y, z, w),
    }
    return intrinsic(kinds[count])


def _power_of_two(builder: Any, n: Any) -> Any:
    biased = builder.add(builder.fptosi(n, _INTS), ir.Constant(_INTS, [127] * WIDTH))
    return builder.bitcast(builder.shl(biased, ir.Constant(_INTS, [23] * WIDTH)), _FLOATS)


def _where(comparison: str) -> Any:
    return _function(lambda b, x, limit, value, other: b.select(_compare(comparison, b, x, limit), value, other))


floor = _function(lambda b, x: _llvm(b, "floor", x))
ceil = _function(lambda b, x: _llvm(b, "ceil", x))
magnitude = _function(lambda b, x: _llvm(b, "fabs", x))
root = _function(lambda b, x: _llvm(b, "sqrt", x))
power_of_two = _function(_power_of_two)  # of whole numbers from -126 to 128, of lanes only; 2^128 is infinite
maximum = _function(lambda b, x, y: b.select(_compare(">", b, x, y), x, y))  # y where x is not a number
minimum = _function(lambda b, x, y: b.select(_compare("<", b, x, y), x, y))
multiply_add = _function(lambda b, x, y, z: _llvm(b, "fmuladd", x, y, z))  # x y + z, whether x y is needed or not
where_above = _where(">")  # (x, limit, value, other): value where x > limit, else other
where_at_least = _where(">=")


@intrinsic
def bits_above(typingctx: Any, x: Any, limit: Any) -> Any:
    """In which lanes x > limit, as bits of an int64: bit i is that of lane i."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(_compare(">", builder, *args), ir.IntType(WIDTH))
        return builder.zext(bits, ir.IntType(64))

    return types.int64(lanes, lanes), generate


@intrinsic
def lowest(typingctx: Any, bits: Any) -> Any:
    """The number of the lowest bit of an int64 that is set; 64 without any."""
    return types.int64(types.int64), lambda context, builder, sig, args: builder.cttz(args[0], ir.IntType(1)(0))


@intrinsic
def highest(typingctx: Any, bits: Any) -> Any:
    """The number of the highest bit of an int64 that is set; -1 without any."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.sub(ir.IntType(64)(63), builder.ctlz(args[0], ir.IntType(1)(0)))

    return types.int64(types.int64), generate


@intrinsic
def spread(typingctx: Any, x: Any) -> Any:
    """The same number in all lanes."""
    return lanes(lanes), lambda context, builder, sig, args: args[0]


@intrinsic
def total(typingctx: Any, x: Any) -> Any:
    """The sum of the lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(_fold(builder, args), _FIRST)

    return types.float32(lanes), generate


@intrinsic
def totals(typingctx: Any, values: Any) -> Any:
    """Lanes that hold the sums of up to sixteen lanes, a tuple; 0 in the rest."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _fold(builder, cgutils.unpack_tuple(builder, args[0]))

    return lanes(values), generate


@intrinsic
def columns(typingctx: Any, array: Any, first: Any) -> Any:
    """The first eight columns of sixteen rows of memory, a tuple of lanes; the rows begin at position `first`."""
    lower_half = types.UniTuple(lanes, WIDTH // 2)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _pointer(context, builder, sig, args)
        rows = [builder.load(builder.gep(start, [ir.Constant(ir.IntType(32), i)])) for i in range(WIDTH)]
        for row in rows:
            row.align = 4
        for size in (8, 4, 2, 1):  # of the blocks off the diagonal, which change places
            left = [j if not j & size else WIDTH + j - size for j in range(WIDTH)]
            right = [j + size if not j & size else WIDTH + j for j in range(WIDTH)]
            for i in range(WIDTH):
                if not i & size:
                    x, y = rows[i], rows[i + size]
                    rows[i], rows[i + size] = _shuffle(builder, x, y, left), _shuffle(builder, x, y, right)
        return context.make_tuple(builder, sig.return_type, rows[: WIDTH // 2])

    return lower_half(array, first), generate


def _fold(builder: Any, vectors: Any) -> Any:
    """Lanes with the sum of each vector: half as many vectors after each round, at first within four neighbours."""
    vectors = [*vectors, *[ir.Constant(_FLOATS, None)] * (WIDTH - len(vectors))]
    for lower, upper in _ROUNDS:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        halves = [(_shuffle(builder, x, y, lower), _shuffle(builder, x, y, upper)) for x, y in pairs]
        vectors = [builder.fadd(x, y, flags=_FLAGS) for x, y in halves]
    return vectors[0]


def _rounds() -> list[tuple[list[int], list[int]]]:
    """Which of the 32 numbers of two vectors are added up in each round of `_fold`."""
    fours = range(0, WIDTH, 4)
    singles = [[f + i + WIDTH * v for f in fours for i in pair for v in (0, 1)] for pair in ((0, 1), (2, 3))]
    pairs = [[f + i + WIDTH * v for f in fours for v in (0, 1) for i in pair] for pair in ((0, 1), (2, 3))]
    across = [[f + i + WIDTH * v for v in (0, 1) for f in start for i in range(4)] for start in ((0, 8), (4, 12))]
    return [(singles[0], singles[1]), (pairs[0], pairs[1]), (across[0], across[1]), (across[0], across[1])]


_ROUNDS = _rounds()
