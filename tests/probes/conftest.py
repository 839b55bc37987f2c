"""One small quantum run for all tests of the probes. They may add tables to its folder, and change nothing."""

from pathlib import Path

import pytest

from qnerf.experiment import run
from tests.helpers.configs import TINY, composed
from tests.helpers.scenes import write_scene


@pytest.fixture(scope="session")
def quantum_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both heads QIREN, with two circuits of 2 wires and S = 2 each."""
    folder = tmp_path_factory.mktemp("probes")
    scene = write_scene(folder / "scene")
    small = ("visibility.resolution=16", "visibility.cameras=0", "hash=C7", "train.steps=3", "train.rays=8")
    quiet = ("train.eval_every=0", "train.log_every=1", f"store={folder / 'runs'}", "device=cpu")
    heads = ("field=qboth", "qiren=1L2S", "qiren.qubits=2")
    return run(composed("scene=nerfstudio", f"scene.path={scene}", *TINY, *small, *quiet, *heads)).path
