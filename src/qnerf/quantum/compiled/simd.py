"""Explicit SIMD for Numba kernels: values that hold one machine vector of consecutive floats.

LLVM does not vectorise the loops of `wire_blocks` by itself: they read and write at too many distances. Here a kernel
says which vectors it wants:

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
from numba import extending, types
from numba.extending import lower_builtin, models, register_model, type_callable

from qnerf.kernels.jit import jit

intrinsic: Any = extending.intrinsic

VECTOR_BYTES = 64 if llvm.get_host_cpu_features().get("avx512f", False) else 32
"""Bytes of one vector, which holds one number of each sample of a block."""


def inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """`jit` for functions that only compiled code calls. What Python would need to call them is not compiled."""
    return jit(function, no_cpython_wrapper=True, no_cfunc_wrapper=True)


def lanes(itemsize: int) -> int:
    """Elements of one vector."""
    return VECTOR_BYTES // itemsize


class Vector(types.Type):
    """Numba's type of one vector of `dtype`."""

    def __init__(self, dtype: Any) -> None:
        self.dtype = dtype
        self.lanes = VECTOR_BYTES * 8 // dtype.bitwidth
        super().__init__(name=f"Vector({dtype}, {self.lanes})")


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, ir.VectorType(manager.lookup(kind.dtype).get_value_type(), kind.lanes))


def pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: Any) -> Any:
    """The address of the vector that starts at array[index], as an LLVM value."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), context.get_value_type(vector).as_pointer())


@intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """The vector at array[index : index + lanes] of a flat, contiguous array. No bounds are checked."""
    vector = Vector(array.dtype)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = pointer(context, builder, array, arguments[0], arguments[1], vector)
        return builder.load(address, align=array.dtype.bitwidth // 8)

    return vector(array, types.intp), generate


@intrinsic
def store(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + lanes] = value."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address = pointer(context, builder, array, arguments[0], arguments[1], value)
        builder.store(arguments[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), generate


@intrinsic
def splat(typing_context: Any, scalar: Any) -> Any:
    """The vector whose elements are all `scalar`."""
    vector = Vector(scalar)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = context.get_value_type(vector)
        undefined = ir.Constant(kind, ir.Undefined)
        first = builder.insert_element(undefined, arguments[0], ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), vector.lanes), [0] * vector.lanes)
        return builder.shuffle_vector(first, undefined, zeros)

    return vector(scalar), generate


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
