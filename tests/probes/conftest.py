"""One small quantum run for all tests of the probes. They may add tables to its folder, and change nothing."""

import pytest

from qnerf.experiment import run
from tests.helpers.configs import MOMENT, TINY, composed
from tests.helpers.scenes import write_scene


@pytest.fixture(scope="session")
def quantum_run(tmp_path_factory):
    """Both heads QIREN, with two circuits of 2 wires and S = 2 each."""
    folder = tmp_path_factory.mktemp("probes")
    scene = ("scene=nerfstudio", f"scene.path={write_scene(folder / 'scene')}", f"store={folder / 'runs'}")
    own = ("field=qboth", "qiren=1L2S", "qiren.qubits=2", "train.steps=3", "visibility.cameras=0")
    return run(composed(*scene, *TINY, *MOMENT, *own)).path
