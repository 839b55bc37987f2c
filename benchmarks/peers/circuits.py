"""The QIREN circuit written for each package: `PEERS[name](wires, spectral)` gives step(x, w, g) -> (y, dx, dw).

x (B, n) are the inputs, w (rows, n, 3) the angles, g (B, n) the gradient of the outputs y (B, n), all NumPy arrays.
Nothing here imports qnerf, so that the file runs in any environment with the package at hand.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

Step = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def gates(wires: int, spectral: int) -> Iterator[tuple[Any, ...]]:
    """("rot", row, wire), ("cz", wire, wire) and ("encode", wire), in order."""
    for block in range(spectral + 1):
        for layer in range(2):
            for wire in range(wires):
                yield "rot", 2 * block + layer, wire
            if wires > 1:
                distance = 1 + layer % (wires - 1)
                for wire in range(wires):
                    yield "cz", wire, (wire + distance) % wires
        if block < spectral:
            for wire in range(wires):
                yield "encode", wire


def _signs(wires: int) -> np.ndarray:
    """(2^wires, wires): the eigenvalue of each wire's Z in each basis state."""
    bits = (np.arange(2**wires)[:, None] >> np.arange(wires - 1, -1, -1)) & 1
    return 1.0 - 2.0 * bits


def _torch_step(forward: Callable[[Any, Any], Any]) -> Step:
    import torch

    def step(x: np.ndarray, w: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        tx, tw = torch.tensor(x, requires_grad=True), torch.tensor(w, requires_grad=True)
        y = forward(tx, tw)
        y.backward(torch.tensor(g).to(y.dtype))
        assert tx.grad is not None
        assert tw.grad is not None
        return y.detach().numpy(), tx.grad.numpy(), tw.grad.numpy()

    return step


def _jax_step(forward: Callable[[Any, Any], Any]) -> Step:
    import jax

    def loss(x: Any, w: Any, g: Any) -> Any:
        y = forward(x, w)
        return (y * g).sum(), y

    compiled = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))

    def step(x: np.ndarray, w: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        (_, y), (dx, dw) = jax.block_until_ready(compiled(x, w, g))
        return np.asarray(y), np.asarray(dx), np.asarray(dw)

    return step


def _pennylane(wires: int, spectral: int, device: str, interface: str, method: str) -> Callable[[Any, Any], Any]:
    import pennylane as qml

    @qml.qnode(qml.device(device, wires=wires), interface=interface, diff_method=method)
    def node(x: Any, w: Any) -> Any:
        for kind, *at in gates(wires, spectral):
            if kind == "rot":
                qml.Rot(w[at[0], at[1], 0], w[at[0], at[1], 1], w[at[0], at[1], 2], wires=at[1])
            elif kind == "cz":
                qml.CZ(wires=at)
            else:
                qml.RZ(x[..., at[0]], wires=at[0])
        return [qml.expval(qml.PauliZ(wire)) for wire in range(wires)]

    return node


def pennylane_torch(wires: int, spectral: int) -> Step:
    import torch

    node = _pennylane(wires, spectral, "default.qubit", "torch", "backprop")
    return _torch_step(lambda x, w: torch.stack(tuple(node(x, w)), -1))


def pennylane_jax(wires: int, spectral: int) -> Step:
    import jax.numpy as jnp

    node = _pennylane(wires, spectral, "default.qubit", "jax", "backprop")
    return _jax_step(lambda x, w: jnp.stack(node(x, w), -1))


def pennylane_jax_vmap(wires: int, spectral: int) -> Step:
    import jax
    import jax.numpy as jnp

    node = _pennylane(wires, spectral, "default.qubit", "jax", "backprop")
    return _jax_step(lambda x, w: jax.vmap(lambda sample: jnp.stack(node(sample, w), -1))(x))


def lightning_adjoint(wires: int, spectral: int) -> Step:
    import torch

    node = _pennylane(wires, spectral, "lightning.qubit", "torch", "adjoint")
    return _torch_step(lambda x, w: torch.stack([torch.stack(tuple(node(sample, w))) for sample in x]))


def tensorcircuit_jax(wires: int, spectral: int, chunk: int = 512) -> Step:
    import jax
    import jax.numpy as jnp
    import tensorcircuit as tc

    tc.set_backend("jax")
    tc.set_dtype("complex64")
    tc.set_contractor("plain")  # gate by gate; the default order of contraction is slower by 16 here
    signs = jnp.asarray(_signs(wires), dtype=jnp.float32)
    block = [gate for gate in gates(wires, 1) if gate[0] != "rot" or gate[1] < 2]
    encoding = next(index for index, gate in enumerate(block) if gate[0] == "encode")

    def run(state: Any, w: Any, x: Any | None) -> Any:
        """One block of two layers (w: (2, wires, 3)), and an encoding of x where it is given."""
        circuit = tc.Circuit(wires, inputs=state)
        for kind, *at in block[: encoding + (0 if x is None else wires)]:
            if kind == "rot":
                circuit.rz(at[1], theta=w[at[0], at[1], 0])
                circuit.ry(at[1], theta=w[at[0], at[1], 1])
                circuit.rz(at[1], theta=w[at[0], at[1], 2])
            elif kind == "cz":
                circuit.cz(*at)
            else:
                circuit.rz(at[0], theta=x[at[0]])  # type: ignore[index]
        return circuit.state()

    def sample(x: Any, w: Any) -> Any:
        # A scan over the equal blocks: written out, S = 4 compiles for more than five minutes.
        blocks = w.reshape(spectral + 1, 2, wires, 3)
        state = jnp.zeros(2**wires, dtype=jnp.complex64).at[0].set(1)
        state, _ = jax.lax.scan(lambda state, block: (run(state, block, x), None), state, blocks[:-1])
        return jnp.abs(run(state, blocks[-1], None)) ** 2 @ signs

    def forward(x: Any, w: Any) -> Any:
        batched = jax.checkpoint(jax.vmap(sample, in_axes=(0, None)))
        size = min(chunk, x.shape[0])
        return jax.lax.map(lambda part: batched(part, w), x.reshape(-1, size, wires)).reshape(-1, wires)

    return _jax_step(forward)


PEERS: dict[str, tuple[Callable[[int, int], Step], str, int | None]] = {
    # name: builder, package, and how many samples are run (then scaled up) if the whole batch would take minutes
    "pennylane default.qubit torch": (pennylane_torch, "pennylane", None),
    "pennylane default.qubit jax jit": (pennylane_jax, "jax", None),
    "pennylane default.qubit jax jit vmap": (pennylane_jax_vmap, "jax", None),
    "pennylane lightning.qubit adjoint": (lightning_adjoint, "pennylane_lightning", 16),
    "tensorcircuit-ng jax jit vmap": (tensorcircuit_jax, "tensorcircuit", None),
}
