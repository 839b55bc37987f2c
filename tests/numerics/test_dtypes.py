"""No float64 arises in a float32 step, nor the reverse, except where it is meant to: every PyTorch operation is seen.

Compiled loops take and give arrays of one dtype (`kernels.compiled`); what they compute with inside is theirs.
"""

import linecache
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import qnerf
from qnerf.quantum import QuantumLayer
from tests.helpers.trainer import trainer

SOURCE = Path(qnerf.__file__).parent
ON_PURPOSE = {
    "encoders/frequency.py": "phases of up to 256 turns are reduced before they are rounded",
    "quantum/angles.py": "angles are added up before they are rounded",
    "quantum/compiled/engine.py": "angles become tables once a step",
    "quantum/lightcone.py": "coefficients of polynomials, once a step",
    "quantum/statevector.py": "products that float32 would round",
}
"""Files in which a float32 step makes float64 tensors, and why."""


class Watcher(TorchDispatchMode):
    """Where floating tensors of more than one number arise that are not of `dtype`: file -> operations."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self.known = {dtype, dtype.to_complex()}
        self.found: dict[str, set[str]] = {}
        self.seen = 0

    def __torch_dispatch__(self, function: Any, types: Any, given: Any = (), options: Any = None) -> Any:
        out = function(*given, **(options or {}))
        for tensor in tree_leaves(out):
            if isinstance(tensor, torch.Tensor) and (tensor.is_floating_point() or tensor.is_complex()):
                self.seen += 1
                if tensor.dtype not in self.known and tensor.numel() > 1:
                    self.found.setdefault(_place(), set()).add(f"{function}")
        return out


BACKWARD = "training/trainer.py"


def _place() -> str:
    """The innermost file of ours on the stack; in a backward pass, "backward"."""
    frame = sys._getframe(2)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(SOURCE):
            name = path.relative_to(SOURCE).as_posix()
            line = linecache.getline(frame.f_code.co_filename, frame.f_lineno)
            return "backward" if name == BACKWARD and ".backward(" in line else name
        frame = frame.f_back
    return "elsewhere"


def stepped(config: dict[str, Any]) -> Watcher:
    """A step in which the proposal networks learn, after one that fills the optimiser and the caches."""
    taken = trainer(config)
    taken.take_step(measure=False)
    with Watcher(next(taken.model.parameters()).dtype) as watcher:
        taken.take_step(measure=True)
    assert watcher.seen > 300
    return watcher


STEPS = {
    "polynomials": (
        ["field=qboth", "qiren=1L1S", "qiren.qubits=3", "qiren.method=lightcone", "train.rays=64"],
        {"quantum/angles.py", "quantum/compiled/engine.py", "quantum/lightcone.py"},
    ),
    "in plain PyTorch": (
        ["field=qboth", "qiren.qubits=3", "color.directions=sh"],
        {"quantum/angles.py", "quantum/statevector.py"},
    ),
    "no circuits": (["field=classical", "cameras=se3", "appearance=2"], set()),
    "random features": (
        ["field=qdensity", "encoder=rff", "qiren.qubits=3", "cameras=so3xr3", "shading=none"],
        {"encoders/frequency.py", "quantum/angles.py", "quantum/compiled/engine.py"},
    ),
}
"""Options, and the files of `ON_PURPOSE` that take part in a step."""


@pytest.mark.parametrize("name", STEPS)
def test_step_in_float32_makes_no_float64_but_on_purpose(
    tiny: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    options, expected = STEPS[name]
    if name == "in plain PyTorch":  # as on CUDA
        build = QuantumLayer.__init__
        monkeypatch.setattr(QuantumLayer, "__init__", lambda *a, **k: build(*a, **k | {"backend": "torch"}))
    found = stepped(tiny(*options, "train.distortion=0.01")).found
    backward = found.pop("backward", set())
    assert set(found) == expected <= set(ON_PURPOSE)
    assert not backward or expected  # only that of what went forward in float64


@pytest.mark.parametrize("name", ["polynomials", "random features"])
def test_step_in_float64_makes_no_float32(tiny: Callable[..., dict[str, Any]], name: str) -> None:
    watcher = stepped(tiny(*STEPS[name][0], "train.distortion=0.01", "numerics.dtype=float64"))
    assert (watcher.known, watcher.found) == ({torch.float64, torch.complex128}, {})


def test_layer_computes_in_the_wider_of_its_own_dtype_and_its_input_s() -> None:
    for method in ("statevector", "lightcone"):
        for backend in ("compiled", "torch"):
            layer = QuantumLayer(3, 1, method=method, backend=backend)
            assert layer(torch.zeros(2, 3)).dtype == torch.float32
            assert layer(torch.zeros(2, 3, dtype=torch.float64)).dtype == torch.float64
            assert layer(torch.zeros(2, 3, dtype=torch.bfloat16)).dtype == torch.float32
            assert layer.double()(torch.zeros(2, 3)).dtype == torch.float64
