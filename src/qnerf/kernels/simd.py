"""Explicit SIMD for Numba kernels: values that hold one machine vector of consecutive floats.

LLVM does not vectorise loops that read and write at many distances, such as those of quantum gates, and chooses narrow
vectors on some processors. Here a kernel says which vectors it wants:

    a, b = load(x, i), load(x, j)  # `lanes` consecutive elements each
    store(x, i, a - t * b)         # element by element; a multiplication and an addition are fused

A vector is VECTOR_BYTES wide and holds float32 or float64, as the array does. If the machine has narrower registers,
LLVM splits it.
"""

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm  # type: ignore[import-untyped]
from llvmlite import ir
from numba import config, extending, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from qnerf.kernels.jit import jit

intrinsic: Any = extending.intrinsic


def has_avx512() -> bool:
    """Whether Numba compiles for AVX-512: by NUMBA_CPU_FEATURES where it is set, else as the machine can."""
    chosen: str | None = config.CPU_FEATURES  # type: ignore[attr-defined]
    if chosen is None:
        return bool(llvm.get_host_cpu_features().get("avx512f", False))
    return "+avx512f" in chosen.split(",")


AVX512 = has_avx512()
VECTOR_BYTES = 64 if AVX512 else 32
"""Bytes of one vector, which holds one number of each sample of a block.

Measured for circuits: on AVX2, 64 bytes take 0.8 (4 wires), 1.07 (8) to 1.25 times (10 wires) as long as 32; with
AVX-512 they take 0.64 to 0.83 times as long, and 1.05 with 10 wires.
"""


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jit` for functions that only compiled code calls. What Python would need to call them is not compiled."""
    return jit(function, no_cpython_wrapper=True)


def lanes(itemsize: int) -> int:
    """Elements of one vector."""
    return VECTOR_BYTES // itemsize


class Vector(types.Type):
    """Numba's type of a vector of `dtype`, by default one machine vector."""

    def __init__(self, dtype: Any, lanes: int | None = None) -> None:
        self.dtype = dtype
        self.lanes = lanes or VECTOR_BYTES * 8 // dtype.bitwidth
        super().__init__(name=f"Vector({dtype}, {self.lanes})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, ir.VectorType(manager.lookup(kind.dtype).get_value_type(), kind.lanes))


def pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: Any) -> Any:
    """The address of the vector that starts at array[index], as an LLVM value."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), context.get_value_type(vector).as_pointer())


def _load(array: Any, vector: Vector) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = pointer(context, builder, array, arguments[0], arguments[1], vector)
        return builder.load(address, align=array.dtype.bitwidth // 8)

    return vector(array, types.intp), generate


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """The vector at array[index : index + lanes] of a flat, contiguous array. No bounds are checked."""
    return _load(array, Vector(array.dtype))


@intrinsic
def load_pair(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index] and array[index + 1] as a vector of two."""
    return _load(array, Vector(array.dtype, 2))


@intrinsic
def store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + lanes] = value."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = pointer(context, builder, array, arguments[0], arguments[1], value)
        builder.store(arguments[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


def _filled(context: Any, builder: Any, scalar: Any, vector: Vector) -> Any:
    """The LLVM value of a vector whose elements are all `scalar`."""
    undefined = ir.Constant(context.get_value_type(vector), ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), vector.lanes), [0] * vector.lanes)
    return builder.shuffle_vector(first, undefined, zeros)


def _splat(scalar: Any, vector: Vector) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _filled(context, builder, arguments[0], vector)

    return vector(scalar), generate


@intrinsic
def splat(typing_context: Any, scalar: Any) -> Any:
    """The vector whose elements are all `scalar`."""
    return _splat(scalar, Vector(scalar))


@intrinsic
def pair(typing_context: Any, scalar: Any) -> Any:
    """A vector of two that are both `scalar`."""
    return _splat(scalar, Vector(scalar, 2))


@intrinsic
def gather(typing_context: Any, array: Any, rows: Any, index: Any) -> Any:
    """The vector of array[rows[index]], array[rows[index + 1]], ... with `rows` of uint32, all below 2^31."""
    return _gather(Vector(array.dtype), array, rows, group=1)


@intrinsic
def gather_pairs(typing_context: Any, array: Any, rows: Any, index: Any) -> Any:
    """As `gather`, of rows of two numbers: the vector of array[2 r], array[2 r + 1], r = rows[index], and so on."""
    return _gather(Vector(array.dtype), array, rows, group=2)


def _gather(vector: Vector, array: Any, rows: Any, group: int) -> Any:
    bits = vector.dtype.bitwidth * group
    count = vector.lanes // group

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        integer, kind = ir.IntType(32), context.get_value_type(vector)
        data = context.make_array(array)(context, builder, arguments[0]).data
        places = Vector(rows.dtype, count)
        start = pointer(context, builder, rows, arguments[1], arguments[2], places)
        numbers = builder.load(start, align=rows.dtype.bitwidth // 8)
        if AVX512 and bits <= 64:
            item = ir.FloatType() if bits == 32 else ir.DoubleType()
            items, byte = ir.VectorType(item, count), ir.IntType(8).as_pointer()
            mask = ir.VectorType(ir.IntType(1), count)
            name = f"llvm.x86.avx512.mask.gather.d{'ps' if bits == 32 else 'pd'}.512"
            kinds = ir.FunctionType(items, [items, byte, ir.VectorType(integer, count), mask, integer])
            function = builder.module.globals.get(name) or ir.Function(builder.module, kinds, name)
            everywhere, zero = ir.Constant(mask, [True] * count), ir.Constant(items, None)
            size = ir.Constant(integer, bits // 8)
            found = builder.call(function, [zero, builder.bitcast(data, byte), numbers, everywhere, size])
            return builder.bitcast(found, kind)
        value = ir.Constant(kind, ir.Undefined)
        for lane in range(count):
            number = builder.zext(builder.extract_element(numbers, ir.Constant(integer, lane)), ir.IntType(64))
            first = builder.mul(number, ir.Constant(ir.IntType(64), group))
            for part in range(group):
                element = builder.load(builder.gep(data, [builder.add(first, ir.Constant(ir.IntType(64), part))]))
                value = builder.insert_element(value, element, ir.Constant(integer, lane * group + part))
        return value

    return vector(array, rows, types.intp), generate


@intrinsic
def load_twice(typing_context: Any, array: Any, index: Any) -> Any:
    """The vector of array[index], array[index], array[index + 1], array[index + 1], ..."""
    vector = Vector(array.dtype)
    half = Vector(array.dtype, vector.lanes // 2)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        start = pointer(context, builder, array, arguments[0], arguments[1], half)
        value = builder.load(start, align=array.dtype.bitwidth // 8)
        order = [lane // 2 for lane in range(vector.lanes)]
        return builder.shuffle_vector(value, value, ir.Constant(ir.VectorType(ir.IntType(32), vector.lanes), order))

    return vector(array, types.intp), generate


@intrinsic
def store_split(typing_context: Any, array: Any, even: Any, odd: Any, value: Any) -> Any:
    """Writes the elements 0, 2, 4, ... of a vector from array[even] on, and the others from array[odd] on."""
    half = Vector(value.dtype, value.lanes // 2)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        for parity in range(2):
            order = [2 * lane + parity for lane in range(half.lanes)]
            mask = ir.Constant(ir.VectorType(ir.IntType(32), half.lanes), order)
            part = builder.shuffle_vector(arguments[3], arguments[3], mask)
            start = pointer(context, builder, array, arguments[0], arguments[1 + parity], half)
            builder.store(part, start, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, value), generate


@intrinsic
def join(typing_context: Any, first: Any, second: Any) -> Any:
    """A vector of two."""
    vector = Vector(first, 2)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value = ir.Constant(context.get_value_type(vector), ir.Undefined)
        for i, part in enumerate(arguments):
            value = builder.insert_element(value, part, ir.Constant(ir.IntType(32), i))
        return value

    return vector(first, second), generate


@intrinsic
def where_positive(typing_context: Any, vector: Any, values: Any) -> Any:
    """`values` where `vector` is above 0 or NaN, else 0. `where_positive(x, x)` is ReLU."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        zero = ir.Constant(arguments[0].type, None)
        positive = builder.fcmp_unordered(">", arguments[0], zero)
        return builder.select(positive, arguments[1], zero)

    return vector(vector, values), generate


@intrinsic
def fused(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c of three numbers, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, a, a), generate


def tile(rows: int, vectors: int) -> Callable[..., Any]:
    """A function of compiled code: `rows` times `vectors` of c = max(c + a b, low), from row i and column j on.

    a (count, depth), b (depth, columns) and c are flat, with their rows so far apart, and the columns of a `a_step`.
    Each number of a is loaded once for all columns of the tile, each vector of b once for all its rows. LLVM keeps the
    sums in registers. Behind the last row, it is computed again.
    """

    @intrinsic
    def function(typing_context, i, j, count, a, a_row, a_step, b, b_row, depth, low, c, c_row):  # type: ignore[no-untyped-def]
        vector, integer = Vector(a.dtype), ir.IntType(64)

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            i, j, count, left, a_row, a_step, right, b_row, depth, low, c, c_row = arguments
            add, times, align, fast = builder.add, builder.mul, vector.dtype.bitwidth // 8, ("contract",)

            def at(array: Any, row: Any, distance: Any, column: Any) -> Any:
                return pointer(context, builder, a, array, add(times(row, distance), column), vector)

            last = builder.sub(count, integer(1))
            numbers = [add(i, integer(r)) for r in range(rows)]
            numbers = [builder.select(builder.icmp_unsigned("<", r, last), r, last) for r in numbers]
            columns = [add(j, integer(v * vector.lanes)) for v in range(vectors)]
            zero = context.get_value_type(vector)(None)
            sums = [[cgutils.alloca_once_value(builder, zero) for _ in columns] for _ in numbers]
            with cgutils.for_range(builder, depth) as loop:
                across = [builder.load(at(right, loop.index, b_row, column), align=align) for column in columns]
                for number, totals in zip(numbers, sums, strict=True):
                    place = at(left, number, a_row, times(loop.index, a_step))
                    factor = builder.load(builder.bitcast(place, zero.type.element.as_pointer()))
                    factor = _filled(context, builder, factor, vector)
                    for x, total in zip(across, totals, strict=True):
                        product = builder.fmul(factor, x, flags=fast)
                        builder.store(builder.fadd(product, builder.load(total), flags=fast), total)
            # All of c is read before any is written: a last row may come several times.
            results = []
            low = _filled(context, builder, low, vector)
            for number, totals in zip(numbers, sums, strict=True):
                for column, total in zip(columns, totals, strict=True):
                    place = at(c, number, c_row, column)
                    result = builder.fadd(builder.load(total), builder.load(place, align=align))
                    result = builder.select(builder.fcmp_unordered(">", result, low), result, low)
                    results.append((result, place))
            for result, place in results:
                builder.store(result, place, align=align)
            return context.get_dummy_value()

        return types.void(i, j, count, a, a_row, a_step, b, b_row, depth, low, c, c_row), generate

    return function


@intrinsic
def transpose(typing_context, x, x_row, count, first, column, out, out_row):  # type: ignore[no-untyped-def]
    """out[k, f] = x[f, k] for as many k from `column` on, and f from `first` on, as a vector has numbers.

    Both are flat, with rows so far apart. `x` has `count` rows; behind the last one, it is taken again.
    """
    vector, integer = Vector(x.dtype), ir.IntType(64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        x_, x_row, count, first, column, out_, out_row = arguments
        lanes, align, add, times = vector.lanes, vector.dtype.bitwidth // 8, builder.add, builder.mul
        last = builder.sub(count, integer(1))
        vectors = []
        for lane in range(lanes):
            row = add(first, integer(lane))
            row = builder.select(builder.icmp_unsigned("<", row, last), row, last)
            place = pointer(context, builder, x, x_, add(times(row, x_row), column), vector)
            vectors.append(builder.load(place, align=align))
        # Vectors of both halves are interleaved, and again, until each has one number of every row.
        orders = [[part * lanes // 2 + i // 2 + i % 2 * lanes for i in range(lanes)] for part in range(2)]
        masks = [ir.Constant(ir.VectorType(ir.IntType(32), lanes), order) for order in orders]
        for _ in range(lanes.bit_length() - 1):
            halves = list(zip(vectors[: lanes // 2], vectors[lanes // 2 :], strict=True))
            vectors = [builder.shuffle_vector(a, b, mask) for a, b in halves for mask in masks]
        for lane, found in enumerate(vectors):
            row = add(column, integer(lane))
            place = pointer(context, builder, out, out_, add(times(row, out_row), first), vector)
            builder.store(found, place, align=align)
        return context.get_dummy_value()

    return types.void(x, x_row, count, first, column, out, out_row), generate


def _operator(symbol: Any, instruction: str) -> None:
    @type_callable(symbol)
    def typing(context: Any) -> Any:
        def kind(a, b):  # type: ignore[no-untyped-def]  # Numba compares the argument lists, annotations included
            return a if isinstance(a, Vector) and isinstance(b, Vector) else None

        return kind

    @lower_builtin(symbol, Vector, Vector)
    def lowering(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return getattr(builder, instruction)(*arguments, flags=("contract",))  # a * b + c may become one instruction


_operator(operator.add, "fadd")
_operator(operator.sub, "fsub")
_operator(operator.mul, "fmul")


@intrinsic
def keep_apart(typing_context: Any) -> Any:
    """Keeps the function that calls this from being inlined: large passes would be compiled again in every caller."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic
def address(typing_context: Any, array: Any) -> Any:
    """Address of the first element."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(array)(context, builder, arguments[0]).data
        return builder.ptrtoint(data, ir.IntType(64))

    return types.int64(array), generate


@inner
def start_of_line(array: Any) -> int:
    """First index of `array` at the start of a cache line (64 bytes). Vectors across two lines are slow."""
    misplaced = address(array) % 64
    return 0 if misplaced == 0 else (64 - misplaced) // array.itemsize
