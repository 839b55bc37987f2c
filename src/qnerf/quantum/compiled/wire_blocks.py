"""Vector code for a few neighbouring wires at once, so that their amplitudes stay in registers.

k neighbouring wires mix 2^k amplitudes: the vectors at `base + m * distance`, m < 2^k, of a flat array. Each function
here is written with loops over the wires but compiled without them. The factors of the wires are a tuple of k vectors,
the most significant wire first.
"""

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types

from qnerf.kernels.simd import intrinsic, pointer

FUSED = ("contract",)


class _Block:
    """The 2^k vectors at one base, as LLVM values."""

    def __init__(
        self, context: Any, builder: Any, array_type: Any, array: Any, distance: Any, vector: Any, k: int
    ) -> None:
        self.context, self.builder, self.array_type, self.array = context, builder, array_type, array
        self.vector, self.align = vector, array_type.dtype.bitwidth // 8
        self.steps = [builder.mul(distance, ir.Constant(distance.type, m)) for m in range(2**k)]

    def _at(self, base: Any, m: int) -> Any:
        index = self.builder.add(base, self.steps[m])
        return pointer(self.context, self.builder, self.array_type, self.array, index, self.vector)

    def load(self, base: Any) -> list[Any]:
        return [self.load_one(base, m) for m in range(len(self.steps))]

    def load_one(self, base: Any, m: int) -> Any:
        return self.builder.load(self._at(base, m), align=self.align)

    def store(self, base: Any, values: list[Any]) -> None:
        for m, value in enumerate(values):
            self.store_one(base, m, value)

    def store_one(self, base: Any, m: int, value: Any) -> None:
        self.builder.store(value, self._at(base, m), align=self.align)

    def madd(self, total: Any, a: Any, b: Any) -> Any:
        return self.builder.fadd(total, self.builder.fmul(a, b, flags=FUSED), flags=FUSED)


def _unpacked(builder: Any, value: Any, count: int) -> list[Any]:
    return [builder.extract_value(value, m) for m in range(count)]


def _packed(context: Any, builder: Any, kind: Any, values: list[Any]) -> Any:
    return context.make_tuple(builder, kind, values)


@intrinsic
def ry_block(typing_context: Any, x: Any, source: Any, target: Any, distance: Any, tangents: Any) -> Any:
    """(1, -t; t, 1) on each wire, from `source` to `target`."""
    k, vector = tangents.count, tangents.dtype

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        block = _Block(context, builder, x, arguments[0], arguments[3], vector, k)
        # All 2^k amplitudes are loaded, go through the k rotations in registers, and are stored.
        a = block.load(arguments[1])
        for j, t in enumerate(_unpacked(builder, arguments[4], k)):
            bit = 1 << (k - 1 - j)
            for m in range(2**k):
                if not m & bit:
                    low, high = a[m], a[m | bit]
                    product = builder.fmul(t, high, flags=FUSED)
                    a[m], a[m | bit] = builder.fsub(low, product, flags=FUSED), block.madd(high, t, low)
        block.store(arguments[2], a)
        return context.get_dummy_value()

    return types.void(x, types.intp, types.intp, types.intp, tangents), generate


@intrinsic
def add_x_block(typing_context: Any, x: Any, state: Any, adjoint: Any, distance: Any, weights: Any) -> Any:
    """adjoint += sum_j weight_j X_j state."""
    k, vector = weights.count, weights.dtype

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        block = _Block(context, builder, x, arguments[0], arguments[3], vector, k)
        # X_j takes amplitude m from the place with bit j flipped. The adjoint is read and written once for all wires.
        a, factors = block.load(arguments[1]), _unpacked(builder, arguments[4], k)
        for m in range(2**k):
            total = block.load_one(arguments[2], m)
            for j, w in enumerate(factors):
                total = block.madd(total, w, a[m ^ (1 << (k - 1 - j))])
            block.store_one(arguments[2], m, total)
        return context.get_dummy_value()

    return types.void(x, types.intp, types.intp, types.intp, weights), generate


@intrinsic
def x_block(typing_context: Any, x: Any, state: Any, distance: Any, sums: Any) -> Any:
    """The tuple `sums` plus the products over the pairs of each wire, each wire's in two vectors: 2 k of them."""
    k, vector = sums.count // 2, sums.dtype

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        block = _Block(context, builder, x, arguments[0], arguments[2], vector, k)
        # The pairs of a wire take turns between two sums: a fused multiply-add has to wait for the last one into the
        # same sum.
        a, total = block.load(arguments[1]), _unpacked(builder, arguments[3], 2 * k)
        for m in range(2**k):
            for j in range(k):
                bit = 1 << (k - 1 - j)
                if not m & bit:
                    at = 2 * j + (m % bit if j == 0 else m >> (k - j)) % 2
                    total[at] = block.madd(total[at], a[m], a[m | bit])
        return _packed(context, builder, sums, total)

    return sums(x, types.intp, types.intp, sums), generate


@intrinsic
def gradient_block(typing_context: Any, x: Any, state: Any, adjoint: Any, distance: Any, sums: Any) -> Any:
    """The tuple `sums` plus, for each wire, the sums over its pairs of adjoint_1 state_0 and of adjoint_0 state_1."""
    k, vector = sums.count // 2, sums.dtype

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        block = _Block(context, builder, x, arguments[0], arguments[3], vector, k)
        # Both states are loaded once for all k wires.
        a, b = block.load(arguments[1]), block.load(arguments[2])
        total = _unpacked(builder, arguments[4], 2 * k)
        for m in range(2**k):
            for j in range(k):
                bit = 1 << (k - 1 - j)
                if not m & bit:
                    total[2 * j] = block.madd(total[2 * j], b[m | bit], a[m])
                    total[2 * j + 1] = block.madd(total[2 * j + 1], b[m], a[m | bit])
        return _packed(context, builder, sums, total)

    return sums(x, types.intp, types.intp, types.intp, sums), generate
