"""A configuration that fits a signal in a moment."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.configs import composed


@pytest.fixture
def fit(tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """`fit("scene=photograph", "head=qiren")`, with small circuits and few points."""
    settings = ("train.steps=4", "train.log_every=1", "train.eval_every=2", "qiren.qubits=2", "train.points=64")

    def make(scene: str, *overrides: str) -> dict[str, Any]:
        small = ["scene.size=12"] if scene == "scene=photograph" else ["scene.samples=100"]
        return composed(scene, *small, *settings, "hash=C7", f"store={tmp_path / 'runs'}", "device=cpu", *overrides)

    return make
