"""Several float32 numbers as one value of a kernel, on which operators act at once.

Where a loop over pixels is left to the compiler, it chooses vectors of half the width that the processor has, keeps
what runs through the loop in memory, and adds up each sum by itself. Kernels that spend their time on pixels say what
they want. Their `WIDTH` numbers are more than one register holds (two with AVX-512, four with AVX2): while an operation
on the first waits for its result, that on the next begins. `totals` adds up sixteen sums in the operations of four.

Lanes have +, - and * with each other and with float32; numbers may be rounded together, as in all kernels (`_FLAGS`).
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.imputils import lower_builtin, lower_cast
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, models, register_model

WIDTH = 16
ROW = 16  # numbers of a row of memory, a cache line
_FLAGS = ("reassoc", "contract", "nsz", "arcp")


class Lanes(types.Type):  # type: ignore[misc]
    """The type of `count` float32."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.vector = ir.VectorType(ir.FloatType(), count)
        super().__init__(f"Lanes({count})")


_PIXELS = Lanes(WIDTH)
_LINE = Lanes(ROW)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.vector)


class _Operation(AbstractTemplate):  # type: ignore[misc]
    def generic(self, args: Any, kws: Any) -> Any:
        """Two lanes, or lanes and a number, which is the same in all of them."""
        kind = next((x for x in args if isinstance(x, Lanes)), None)
        if kind is None or kws or any(x not in (kind, types.float32) for x in args):
            return None
        return signature(kind, *([kind] * len(args)))


def _define(function: Callable[..., Any], name: str) -> None:
    infer_global(function)(type(f"_{name}", (_Operation,), {}))

    @lower_builtin(function, Lanes, Lanes)  # type: ignore[untyped-decorator]
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, name)(*args, flags=_FLAGS)


_define(operator.add, "fadd")
_define(operator.sub, "fsub")
_define(operator.mul, "fmul")


@lower_cast(types.float32, Lanes)  # type: ignore[untyped-decorator]
def _spread(context: Any, builder: Any, fromty: Any, toty: Any, value: Any) -> Any:
    nothing = ir.Constant(toty.vector, ir.Undefined)
    single = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
    return _shuffle(builder, single, nothing, [0] * toty.count)


def _shuffle(builder: Any, x: Any, y: Any, order: list[int]) -> Any:
    """A vector of the numbers of x and y at these positions; those of y count on from those of x."""
    return builder.shuffle_vector(x, y, ir.Constant(ir.VectorType(ir.IntType(32), len(order)), order))


def _llvm(builder: Any, name: str, kind: Any, args: Any) -> Any:
    """Call a function of LLVM on vectors."""
    function = ir.FunctionType(kind.vector, [kind.vector] * len(args))
    return builder.call(cgutils.get_or_insert_function(builder.module, function, f"llvm.{name}.v{kind.count}f32"), args)


def _compare(comparison: str, builder: Any, x: Any, y: Any) -> Any:
    return builder.fcmp_ordered(comparison, x, y, flags=_FLAGS)


def _pointer(context: Any, builder: Any, kind: Any, sig: Any, args: Any) -> Any:
    """Where the numbers of an array `args[0]` begin, from position `args[1]` on."""
    data = context.make_array(sig.args[0])(context, builder, args[0]).data
    index = context.cast(builder, args[1], sig.args[1], types.intp)
    return builder.bitcast(builder.gep(data, [index]), kind.vector.as_pointer())


def _loader(kind: Lanes) -> Any:
    @intrinsic  # type: ignore[untyped-decorator]
    def function(typingctx: Any, array: Any, first: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            value = builder.load(_pointer(context, builder, kind, sig, args))
            value.align = 4
            return value

        return kind(array, first), generate

    return function


load = _loader(_PIXELS)  # (array, first): WIDTH numbers of a contiguous float32 array `(n,)`, from `first` on
load_row = _loader(_LINE)  # ROW numbers


@intrinsic  # type: ignore[untyped-decorator]
def store(typingctx: Any, array: Any, first: Any, value: Any) -> Any:
    """Write lanes to a contiguous float32 array `(n,)`, from position `first` on."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        instruction = builder.store(args[2], _pointer(context, builder, value, sig, args))
        instruction.align = 4
        return context.get_dummy_value()

    return types.none(array, first, value), generate


def _function(generate: Callable[..., Any], arguments: int) -> Any:
    """A function of lanes, or numbers that become lanes; `generate` is called with builder, type and values."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return generate(builder, sig.return_type, *args)

    def kind_of(*args: Any) -> Any:
        kind = next((x for x in args if isinstance(x, Lanes)), _PIXELS)
        return kind(*[kind] * len(args)), lower

    if arguments == 1:
        return intrinsic(lambda typingctx, x: kind_of(x))
    if arguments == 2:
        return intrinsic(lambda typingctx, x, y: kind_of(x, y))
    if arguments == 3:
        return intrinsic(lambda typingctx, x, y, z: kind_of(x, y, z))
    return intrinsic(lambda typingctx, x, limit, value, other: kind_of(x, limit, value, other))


def _power_of_two(builder: Any, kind: Any, n: Any) -> Any:
    ints = ir.VectorType(ir.IntType(32), kind.count)
    biased = builder.add(builder.fptosi(n, ints), ir.Constant(ints, [127] * kind.count))
    return builder.bitcast(builder.shl(biased, ir.Constant(ints, [23] * kind.count)), kind.vector)


def _where(comparison: str) -> Any:
    return _function(lambda b, kind, x, limit, value, other: b.select(_compare(comparison, b, x, limit), value, other), 4)


spread = _function(lambda b, kind, x: x, 1)  # the same number in all lanes
floor = _function(lambda b, kind, x: _llvm(b, "floor", kind, [x]), 1)
magnitude = _function(lambda b, kind, x: _llvm(b, "fabs", kind, [x]), 1)
power_of_two = _function(_power_of_two, 1)  # of whole numbers from -126 to 128; 2^128 is infinite
maximum = _function(lambda b, kind, x, y: b.select(_compare(">", b, x, y), x, y), 2)  # y where x is not a number
minimum = _function(lambda b, kind, x, y: b.select(_compare("<", b, x, y), x, y), 2)
multiply_add = _function(lambda b, kind, *xyz: _llvm(b, "fmuladd", kind, xyz), 3)  # x y + z, if x y is needed or not
where_above = _where(">")  # (x, limit, value, other): value where x > limit, else other
where_at_least = _where(">=")


@intrinsic  # type: ignore[untyped-decorator]
def total(typingctx: Any, x: Any) -> Any:
    """The sum of the lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(_fold(builder, x, args), ir.Constant(ir.IntType(32), 0))

    return types.float32(x), generate


@intrinsic  # type: ignore[untyped-decorator]
def totals(typingctx: Any, values: Any) -> Any:
    """A row that holds the sums of the lanes of up to sixteen values, a tuple; 0 in the rest."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _fold(builder, values[0], cgutils.unpack_tuple(builder, args[0]))

    return _LINE(values), generate


def _fold(builder: Any, kind: Any, vectors: Any) -> Any:
    """A row with the sum of each vector: half as many after each round, at first within four neighbours."""
    half = range(ROW)
    while kind.count > ROW:
        parts = [[_shuffle(builder, x, x, [i + ROW * j for i in half]) for x in vectors] for j in (0, 1)]
        vectors = [builder.fadd(x, y, flags=_FLAGS) for x, y in zip(*parts, strict=True)]
        kind = _LINE
    vectors = [*vectors, *[ir.Constant(kind.vector, None)] * (ROW - len(vectors))]
    for lower, upper in _ROUNDS:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        halves = [(_shuffle(builder, x, y, lower), _shuffle(builder, x, y, upper)) for x, y in pairs]
        vectors = [builder.fadd(x, y, flags=_FLAGS) for x, y in halves]
    return vectors[0]


def _rounds() -> list[tuple[list[int], list[int]]]:
    """Which of the 32 numbers of two rows are added up in each round of `_fold`."""
    fours = range(0, ROW, 4)
    singles = [[f + i + ROW * v for f in fours for i in pair for v in (0, 1)] for pair in ((0, 1), (2, 3))]
    pairs = [[f + i + ROW * v for f in fours for v in (0, 1) for i in pair] for pair in ((0, 1), (2, 3))]
    across = [[f + i + ROW * v for v in (0, 1) for f in start for i in range(4)] for start in ((0, 8), (4, 12))]
    return [(singles[0], singles[1]), (pairs[0], pairs[1]), (across[0], across[1]), (across[0], across[1])]


_ROUNDS = _rounds()
