"""The compiled state-vector engine: CPU, float32 and float64, with its own adjoint backward.

Per step: angles become tables (`binding.bind`) and the part of the circuit before the first encoding is applied to one
state. Per block of samples: the rest of the circuit, and the closing RY layer only as a rotation of what is measured.
The backward pass runs the block again, keeping the state before each RY layer (in cache, a few hundred KiB), then pulls
the dual state sum_k g_k O_k |psi> back gate by gate: every gradient is one inner product of the two states. Nothing
is stored between forward and backward except <Z> and <X>, so memory does not depend on S.

Sums over samples are taken over a fixed number of parts in a fixed order: results do not depend on the number of
threads.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from qnerf.kernels.jit import jit, run
from qnerf.quantum.compiled import backward_passes, forward_passes
from qnerf.quantum.compiled.binding import PERMUTE, PHASE, START, TURN, TURN_EACH, Tape, bind, record, unbind
from qnerf.quantum.compiled.simd import inner, keep_apart, lanes, load, splat, start_of_line, store
from qnerf.quantum.normal_form import Program

PARTS = 32


@inner
def _rotate(x: Any, cosines: int, n: int, width: int, fixed: Any, flips: Any, out: int) -> None:
    """Vectors of cos and sin of half of (input angle + fixed angle)."""
    keep_apart()
    for j in range(n):
        c, s = load(x, cosines + j * width), splat(flips[j]) * load(x, cosines + (n + j) * width)
        u, v = splat(fixed[0, j]), splat(fixed[1, j])
        store(x, out + j * width, u * c - v * s)
        store(x, out + (n + j) * width, u * s + v * c)


@inner
def _apply(
    x: Any, n: int, width: int, operations: Any, state: int, trig: int, phases: int, mixed: int, keep: bool,
    psi: Any, tables: Any, tangents: Any, masks: Any, flips: Any, permutations: Any,
) -> int:  # fmt: skip
    """Runs the operations; returns where the final state lies. `keep` leaves the state before each layer behind."""
    keep_apart()
    pair = 2 * (width << n)
    here = state
    for o in range(len(operations)):
        code, step, table = operations[o, 0], operations[o, 1], operations[o, 2]
        p = -1 if table < 0 else phases + table * (pair >> 1)
        after = here + pair if keep else here
        if code == START:
            forward_passes.start(x, here, n, width, psi, p, masks[step] if step >= 0 else 0)
        elif code == PHASE:
            forward_passes.phase(x, here, n, width, tables[step], p, masks[step])
        elif code == TURN:
            forward_passes.turn(x, here, after, n, width, tangents[step, 0], True)
            here = after
        elif code == TURN_EACH:
            _rotate(x, trig + 2 * table * n * width, n, width, tangents[step], flips[step], mixed)
            forward_passes.turn_each(x, here, after, n, width, mixed, mixed + n * width, True)
            here = after
        else:
            if not keep:
                after = state + pair if here == state else state
            forward_passes.permute(x, here, after, n, width, permutations[operations[o, 3]], True)
            here = after
    return here


@inner
def _pull(
    x: Any, n: int, width: int, operations: Any, here: int, dual: int, trig: int, phases: int, mixed: int, q: int, d:
    int, sums: int, total: int, inputs: int, gains: Any, tables: Any, tangents: Any, masks: Any, flips: Any,
    permutations: Any,
) -> None:  # fmt: skip
    """Pulls `dual` back through the operations; `here` is the last of the kept states.

    Adds to sums (steps x n vectors), total (dual of the starting state) and inputs (n vectors).
    """
    keep_apart()
    pair = 2 * (width << n)
    for o in range(len(operations) - 1, -1, -1):
        code, step, table = operations[o, 0], operations[o, 1], operations[o, 2]
        p = -1 if table < 0 else phases + table * (pair >> 1)
        if code == TURN:
            forward_passes.turn(x, dual, dual, n, width, tangents[step, 0], False)
            here -= pair
            backward_passes.turn_gradient(x, here, dual, n, width, d)
        elif code == TURN_EACH:
            _rotate(x, trig + 2 * table * n * width, n, width, tangents[step], flips[step], mixed)
            forward_passes.turn_each(x, dual, dual, n, width, mixed, mixed + n * width, False)
            here -= pair
            backward_passes.turn_gradient(x, here, dual, n, width, d)
        elif code == PERMUTE:
            here -= pair
            forward_passes.permute(x, dual, dual + pair, n, width, permutations[operations[o, 3]], False)
            for i in range(0, pair, width):
                store(x, dual + i, load(x, dual + pair + i))
        elif code == PHASE:
            backward_passes.phase_pull(x, here, dual, n, width, tables[step], p, masks[step], q, d)
        else:
            backward_passes.start_pull(x, here, dual, n, width, p, masks[step] if step >= 0 else 0, q, d, total)
        if step >= 0 and code != PERMUTE:
            for j in range(n):
                value = load(x, d + j * width)
                at = sums + (step * n + j) * width
                store(x, at, load(x, at) + value)
                if table >= 0:
                    gain = splat(x.dtype.type(gains[step, j] * flips[step, j]))
                    store(x, inputs + j * width, load(x, inputs + j * width) + gain * value)


@inner
def _sum(x: Any, at: int, width: int) -> float:
    keep_apart()
    value = 0.0
    for i in range(at, at + width):
        value += x[i]
    return value


@inner
def _room(n: int, width: int, slots: int, tables: int, steps: int) -> int:
    return (width << n) * (2 * slots + 7 + tables) + width * n * (2 * tables + 8 + steps) + 64


@jit
def prepare(
    operations: Any, n: int, width: int, amplitude: float, like: Any, tables: Any, tangents: Any, masks: Any,
    flips: Any, permutations: Any, psi: Any,
) -> None:  # fmt: skip
    """psi (2, 2^n): the state before the first encoding."""
    x = np.empty(_room(n, width, 2, 0, 0), like.dtype)
    state = start_of_line(x)
    size = width << n
    zero = np.zeros((2, 1 << n), like.dtype)
    zero[0, 0] = amplitude
    end = _apply(x, n, width, operations, state, 0, 0, 0, False, zero, tables, tangents, masks, flips, permutations)
    for b in range(1 << n):
        psi[0, b] = x[end + b * width]
        psi[1, b] = x[end + size + b * width]


@jit
def prepare_backward(
    operations: Any, n: int, width: int, amplitude: float, dual_psi: Any, tables: Any, tangents: Any, masks: Any,
    flips: Any, permutations: Any, gains: Any, sums_out: Any,
) -> None:  # fmt: skip
    """sums_out (steps, n) += gradients of the angles before the first encoding, from the dual (2, 2^n) of psi."""
    steps = len(masks)
    slots = 1 + len(operations)
    x = np.zeros(_room(n, width, slots, 0, steps), tables.dtype)
    size = width << n
    state = start_of_line(x)
    dual = state + 2 * slots * size
    q = dual + 4 * size
    total = q + size
    d = total + 2 * size
    sums = d + n * width
    zero = np.zeros((2, 1 << n), tables.dtype)
    zero[0, 0] = amplitude
    end = _apply(x, n, width, operations, state, 0, 0, 0, True, zero, tables, tangents, masks, flips, permutations)
    for b in range(1 << n):
        x[dual + b * width] = dual_psi[0, b]
        x[dual + size + b * width] = dual_psi[1, b]
    _pull(
        x, n, width, operations, end, dual, 0, 0, 0, q, d, sums, total, d, gains, tables, tangents, masks, flips,
        permutations
    )  # fmt: skip
    for step in range(steps):
        for j in range(n):
            sums_out[step, j] += x[sums + (step * n + j) * width]


@jit
def forward(
    first: int, last: int, parts: int, operations: Any, n: int, width: int, trig: Any, psi: Any, tables: Any,
    tangents: Any, masks: Any, flips: Any, permutations: Any, local: bool, wires: Any, parity: Any, closing: Any,
    kept: Any, out: Any,
) -> None:  # fmt: skip
    """Blocks of the parts first..last. trig (blocks, tables, 2, n, W); kept (blocks, 2, n, W); out (blocks, words,
    W)."""
    blocks, count = trig.shape[0], trig.shape[1]
    size = width << n
    x = np.empty(_room(n, width, 2, count, 0), psi.dtype)
    state = start_of_line(x)
    phases = state + 4 * size
    q = phases + count * size
    at = q + size
    mixed = at + 2 * count * n * width
    d = mixed + 2 * n * width
    for block in range(blocks * first // parts, blocks * last // parts):
        _read(x, at, trig[block], n, width, phases)
        end = _apply(
            x, n, width, operations, state, at, phases, mixed, False, psi, tables, tangents, masks, flips, permutations
        )  # fmt: skip
        forward_passes.squares(x, end, n, width, q)
        if local:
            forward_passes.fold(x, q, n, width, d)
            forward_passes.flips(x, end, n, width, d + n * width)
            for j in range(n):
                for i in range(width):
                    kept[block, 0, j, i] = x[d + j * width + i]
                    kept[block, 1, j, i] = x[d + (n + j) * width + i]
            for k in range(len(wires)):
                j = wires[k]
                for i in range(width):
                    out[block, k, i] = closing[0, j] * kept[block, 0, j, i] + closing[1, j] * kept[block, 1, j, i]
        else:
            for k in range(len(wires)):
                value = splat(psi.dtype.type(0))
                for b in range(1 << n):
                    value = value + splat(parity[k, b]) * load(x, q + b * width)
                store(x, d, value)
                for i in range(width):
                    out[block, k, i] = x[d + i]


@inner
def _read(x: Any, at: int, trig: Any, n: int, width: int, phases: int) -> None:
    """Copies a block's cosines and sines, and forms the phases of all basis states."""
    keep_apart()
    size = width << n
    for table in range(trig.shape[0]):
        here = at + 2 * table * n * width
        for part in range(2):
            for j in range(n):
                for i in range(width):
                    x[here + (part * n + j) * width + i] = trig[table, part, j, i]
        forward_passes.products(x, phases + table * size, n, width, here, here + n * width)


@jit
def backward(
    first: int, last: int, parts: int, operations: Any, n: int, width: int, trig: Any, psi: Any, tables: Any,
    tangents: Any, masks: Any, flips: Any, permutations: Any, local: bool, wires: Any, parity: Any, closing: Any,
    kept: Any, slots: int, gains: Any, gradient: Any, inputs_out: Any, sums_out: Any, dual_out: Any,
) -> None:  # fmt: skip
    """Gradients of the inputs (blocks, n, W); of angles (parts, steps, n) and of psi (parts, 2, 2^n), summed over
    each part."""
    blocks, count, steps = trig.shape[0], trig.shape[1], len(masks)
    size = width << n
    x = np.zeros(_room(n, width, slots, count, steps), psi.dtype)
    state = start_of_line(x)
    dual = state + 2 * slots * size
    q = dual + 4 * size
    total = q + size + width  # `backward_passes.observe` needs one vector more than the amplitudes
    phases = total + 2 * size
    at = phases + count * size
    mixed = at + 2 * count * n * width
    d = mixed + 2 * n * width
    weight = d + n * width
    inputs = weight + 2 * n * width
    sums = inputs + n * width
    zero = splat(psi.dtype.type(0))
    for part in range(first, last):
        for i in range(sums, sums + steps * n * width, width):
            store(x, i, zero)
        for i in range(total, total + 2 * size, width):
            store(x, i, zero)
        for block in range(blocks * part // parts, blocks * (part + 1) // parts):
            _read(x, at, trig[block], n, width, phases)
            end = _apply(
                x, n, width, operations, state, at, phases, mixed, True, psi, tables, tangents, masks, flips,
                permutations
            )  # fmt: skip
            if local:
                for i in range(weight, weight + 2 * n * width, width):
                    store(x, i, zero)
                for k in range(len(wires)):
                    j = wires[k]
                    a, b, c = weight + j * width, weight + (n + j) * width, sums + ((steps - 1) * n + j) * width
                    for i in range(width):
                        g = gradient[block, k, i]
                        x[a + i] += closing[0, j] * g
                        x[b + i] += closing[1, j] * g
                        x[c + i] += g * (closing[2, j] * kept[block, 0, j, i] + closing[3, j] * kept[block, 1, j, i])
                backward_passes.observe(x, end, dual, n, width, weight, q)
            else:
                for i in range(0, 2 * size, width):
                    store(x, dual + i, zero)
                for k in range(len(wires)):
                    for i in range(width):
                        x[d + i] = gradient[block, k, i]
                    g = load(x, d)
                    for b in range(1 << n):
                        i = b * width
                        value = splat(parity[k, b]) * g
                        store(x, dual + i, load(x, dual + i) + value * load(x, end + i))
                        i += size
                        store(x, dual + i, load(x, dual + i) + value * load(x, end + i))
            for i in range(inputs, inputs + n * width, width):
                store(x, i, zero)
            _pull(
                x, n, width, operations, end, dual, at, phases, mixed, q, d, sums, total, inputs, gains, tables,
                tangents, masks, flips, permutations,
            )  # fmt: skip
            for j in range(n):
                for i in range(width):
                    inputs_out[block, j, i] = x[inputs + j * width + i]
        for step in range(steps):
            for j in range(n):
                sums_out[part, step, j] = _sum(x, sums + (step * n + j) * width, width)
        for b in range(1 << n):
            dual_out[part, 0, b] = _sum(x, total + b * width, width)
            dual_out[part, 1, b] = _sum(x, total + size + b * width, width)


class Engine:
    """A program ready to run. `forward` and `backward` work on NumPy arrays in blocks of `lanes` samples."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.tape: Tape = record(program)

    def bound(self, weights: np.ndarray, dtype: Any) -> "Bound":
        return Bound(self.tape, weights, dtype)


class Bound:
    """An engine with its angles: valid for one step."""

    def __init__(self, tape: Tape, weights: np.ndarray, dtype: Any) -> None:
        """weights: (rows * 3, n) float64, radians."""
        self.tape, self.dtype = tape, np.dtype(dtype)
        steps, n = tape.constants.shape
        self.n, self.width = n, lanes(self.dtype.itemsize)
        tangents, tables = np.zeros((steps, 2, n)), np.zeros((steps, 2, 2**n))
        self.masks, self.flips = np.zeros(steps, dtype=np.int64), np.zeros((steps, n))
        self.closing, parity = np.zeros((4, n)), np.empty(tape.parities.shape)
        local = tape.program.local
        self.amplitude = bind(
            tape.codes, tape.first, tape.entries, tape.constants, tape.signs, tape.controls, tape.parities, local,
            weights, tangents, tables, self.masks, self.flips, self.closing, parity,
        )  # fmt: skip
        self.tangents, self.tables = tangents.astype(self.dtype), tables.astype(self.dtype)
        self.parity, self.factors = parity.astype(self.dtype), self.flips.astype(self.dtype)
        self.psi = np.empty((2, 2**n), self.dtype)
        prepare(
            tape.prelude, n, self.width, self.amplitude, self.psi, self.tables, self.tangents, self.masks, self.factors,
            tape.permutations, self.psi,
        )  # fmt: skip
        self.start = self.psi
        code, step, _, _ = tape.main[0]
        self.opening = int(step) if code == START else -1
        if self.opening >= 0:  # the first encoding's fixed phases belong to the state it starts from
            u, v = self.tables[self.opening]
            self.start = np.stack([u * self.psi[0] - v * self.psi[1], u * self.psi[1] + v * self.psi[0]])

    def _shared(self, trig: np.ndarray) -> tuple[Any, ...]:
        tape = self.tape
        return (
            tape.main, self.n, self.width, trig, self.start, self.tables, self.tangents, self.masks, self.factors,
            tape.permutations, tape.program.local, tape.wires, self.parity, self.closing.astype(self.dtype),
        )  # fmt: skip

    def forward(self, trig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """trig (blocks, tables, 2, n, W) -> outputs (blocks, words, W), and <Z>, <X> (blocks, 2, n, W)."""
        blocks = trig.shape[0]
        kept = np.empty((blocks if self.tape.program.local else 0, 2, self.n, self.width), self.dtype)
        out = np.empty((blocks, len(self.tape.wires), self.width), self.dtype)
        parts = min(PARTS, max(blocks, 1))
        run(forward, parts, parts, *self._shared(trig), kept, out)
        return out, kept

    def backward(self, trig: np.ndarray, kept: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradients of the inputs (blocks, n, W) and of the weights (rows * 3, n)."""
        tape, n = self.tape, self.n
        blocks, steps = trig.shape[0], len(tape.codes)
        parts = min(PARTS, max(blocks, 1))
        inputs = np.empty((blocks, n, self.width), self.dtype)
        sums, dual = np.zeros((parts, steps, n)), np.zeros((parts, 2, 2**n))
        run(backward, parts, parts, *self._shared(trig), kept, tape.slots, tape.gains, gradient, inputs, sums, dual)
        total, pulled = sums.sum(0), dual.sum(0)
        if self.opening >= 0:
            u, v = self.tables[self.opening].astype(np.float64)
            pulled = np.stack([u * pulled[0] + v * pulled[1], u * pulled[1] - v * pulled[0]])
        prepare_backward(
            tape.prelude, n, self.width, self.amplitude, pulled, self.tables, self.tangents, self.masks, self.factors,
            tape.permutations, tape.gains, total,
        )  # fmt: skip
        weights = np.zeros((tape.program.circuit.rows * 3, n))
        unbind(tape.first, tape.entries, self.flips, total, weights)
        return inputs, weights


# NumPy rather than torch from here on: these arrays are small, and torch would wake its OpenMP threads for them, which
# on a busy machine takes far longer than the work.
def blocked(x: np.ndarray, width: int) -> np.ndarray:
    """(B, n) -> (blocks, n, W), padded with zeros."""
    batch, n = x.shape
    blocks = -(-batch // width)
    if blocks * width != batch:
        x = np.concatenate([x, np.zeros((blocks * width - batch, n), x.dtype)])
    return np.ascontiguousarray(x.reshape(blocks, width, n).transpose(0, 2, 1))


def unblocked(x: np.ndarray, batch: int) -> Tensor:
    """(blocks, n, W) -> (B, n)."""
    flat = np.ascontiguousarray(x.transpose(0, 2, 1)).reshape(-1, x.shape[1])
    return torch.from_numpy(flat[:batch])


def waves(x: np.ndarray, factors: np.ndarray, out: np.ndarray) -> None:
    """out[0], out[1] = cos, sin of the inputs (blocks, n, W) times a factor (n,) for each wire; infinities give NaN.

    Products that the inputs' dtype would round are taken in float64: of an angle of 1e3 an error of 1e-4 would be left.
    """
    mantissas = np.abs(np.frexp(factors)[0])
    exact = bool(((mantissas == 0.5) | (mantissas == 0)).all())
    angles = factors[:, None].astype(x.dtype if exact else np.float64) * x
    with np.errstate(invalid="ignore"):
        np.cos(angles, out=out[0], casting="same_kind")
        np.sin(angles, out=out[1], casting="same_kind")


def trigonometry(x: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """cos and sin of half the scaled inputs: (blocks, n, W) -> (blocks, tables, 2, n, W)."""
    out = np.empty((x.shape[0], len(scales), 2, *x.shape[1:]), x.dtype)
    for table, scale in enumerate(scales):
        waves(x, 0.5 * scale, out[:, table].swapaxes(0, 1))
    return out


class _Simulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, engine: Engine, x: Tensor, weights: Tensor) -> Tensor:
        bound = engine.bound(flat_weights(weights), numpy_dtype(x.dtype))
        trig = trigonometry(blocked(x.detach().numpy(), bound.width), engine.tape.scales)
        out, kept = bound.forward(trig)
        ctx.saved = bound, trig, kept
        ctx.shapes = x.shape[0], weights.shape, weights.dtype
        return unblocked(out, x.shape[0]).clamp_(-1, 1)  # rounding may lead beyond

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, Tensor, Tensor]:
        bound, trig, kept = ctx.saved
        batch, shape, dtype = ctx.shapes
        inputs, weights = bound.backward(trig, kept, blocked(gradient.detach().numpy(), bound.width))
        return None, unblocked(inputs, batch), torch.from_numpy(weights).to(dtype).reshape(shape)


def numpy_dtype(dtype: torch.dtype) -> Any:
    return np.float32 if dtype == torch.float32 else np.float64


def flat_weights(weights: Tensor) -> np.ndarray:
    """Stacked weights (rows, 3, n) -> (rows * 3, n) float64."""
    return weights.detach().double().reshape(-1, weights.shape[-1]).contiguous().numpy()


def evaluate(engine: Engine, x: Tensor, weights: Tensor) -> Tensor:
    """Expectation values (B, outputs) for inputs x (B, n) in radians and stacked weights (rows, 3, n), on the CPU."""
    return _Simulate.apply(engine, x, weights)
