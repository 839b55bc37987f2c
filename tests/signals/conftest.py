"""A configuration that fits a signal in a moment."""

import pytest

from tests.helpers.configs import composed


@pytest.fixture
def fit(tmp_path):
    """`fit("scene=photograph", "head=qiren")`, with small circuits and few points."""
    settings = ("train.steps=4", "train.log_every=1", "train.eval_every=2", "qiren.qubits=2", "train.points=64")

    def make(scene, *overrides):
        small = ["scene.size=12"] if scene == "scene=photograph" else ["scene.samples=100"]
        return composed(scene, *small, *settings, "hash=C7", f"store={tmp_path / 'runs'}", "device=cpu", *overrides)

    return make
