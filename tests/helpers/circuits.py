"""Random circuits over every gate, numbered: the engines' and the tapes' tests run them."""

import os
from math import pi
from random import Random

import torch
from hypothesis import strategies as st

from qnerf.quantum.circuit import GATES, Amplitudes, Circuit, Gate, Hamiltonian, Probabilities, Weights, feature
from qnerf.quantum.expressions import Expression

COUNT = 2000 if os.environ.get("QNERF_HYPOTHESIS") == "long" else 200
CHUNKS = [range(first, first + 50) for first in range(0, COUNT, 50)]
"""Numbers of circuits, so that parts of a test run side by side."""

SPECIAL = [0.0, pi / 2, -pi / 2, pi, -pi, 2 * pi, 4 * pi, 1e-9]
W = Weights("w", (2, 2))
FEATURES = 3


def random_circuit(number):
    """1 to 4 wires, 3 features, weights `w` (2, 2). Angles are numbers, special ones too, and polynomials."""
    rng = Random(number)
    n = rng.randint(1, 4)
    operations = [_amplitudes(rng, n)] if rng.random() < 0.3 else []
    # Few gates of many, or many of few, which merge and cancel.
    names = [name for name, kind in GATES.items() if kind.wires <= n]
    names = names if rng.random() < 0.5 else rng.sample(names, min(5, len(names)))
    for _ in range(rng.randint(1, 16)):
        name = rng.choice(names)
        wires = tuple(rng.sample(range(n), GATES[name].wires or rng.randint(1, n)))
        word = "".join(rng.choices("XYZI", k=len(wires))) if name == "PauliRot" else ""
        angles = [_angle(rng) for _ in range(GATES[name].angles)]
        if name == "IsingXY":  # PennyLane's own has no gradient of a batch of angles
            angles = [angle.parts()[0] for angle in angles]
        operations.append(Gate(name, wires, tuple(angles), word))
    return Circuit(f"number {number}", n, operations, _observables(rng, n), FEATURES, W)


any_circuits = st.integers(0, 10**6).map(random_circuit)


def _angle(rng):
    number = rng.choice([*SPECIAL, rng.uniform(-4, 4)])
    own, x = W[rng.randrange(2), rng.randrange(2)], feature(rng.randrange(FEATURES))
    kinds = [number, own, x, -0.5 * own, 3.0 * x, own + number, own + x, own * x + 0.3, x * x - own * own]
    return Expression.of(rng.choice(kinds))


def _amplitudes(rng, n):
    wires = rng.sample(range(n), rng.randint(1, min(n, 2)))
    parts = [[rng.choice([1.0, W[0, 0] + 2, feature(0) + 2, 0.3]) for _ in range(2 ** len(wires))] for _ in range(2)]
    return Amplitudes(tuple(wires), tuple(parts[0]), tuple(parts[1]) if rng.random() < 0.5 else ())


def _observables(rng, n):
    def word():
        return tuple((wire, rng.choice("XYZ")) for wire in rng.sample(range(n), rng.randint(1, n)))

    if rng.random() < 0.4:  # one letter a wire, as engines fold it into the last layer
        return [((wire, letter),) for wire, letter in zip(range(n), rng.choices("XYZZZ", k=n), strict=True)]
    kinds = [
        word, lambda: Hamiltonian((0.7, -1.3, 0.2), (word(), word(), ())),
        lambda: Probabilities(tuple(rng.sample(range(n), rng.randint(1, n)))),
    ]  # fmt: skip
    return [rng.choice(kinds)() for _ in range(rng.randint(1, 3))]


def derivatives(y, *inputs):
    """First derivatives of a random combination of y, and second ones of a random combination of those."""
    generator = torch.Generator().manual_seed(1)

    def of(outputs):
        parts = [own * torch.randn(own.shape, generator=generator, dtype=torch.float64) for own in outputs]
        total = torch.stack([part.sum() for part in parts]).sum()
        if not total.requires_grad:
            return [torch.zeros_like(own) for own in inputs]
        found = torch.autograd.grad(total, inputs, create_graph=True, allow_unused=True)
        return [torch.zeros_like(own) if one is None else one for own, one in zip(inputs, found, strict=True)]

    first = of((y,))
    return [own.detach() for own in (*first, *of(tuple(first)))]
