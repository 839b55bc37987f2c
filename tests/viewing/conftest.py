"""One small finished run, shared by the tests of this folder."""

from pathlib import Path

import pytest

from qnerf.experiment import run
from qnerf.probes import Trained, load
from tests.helpers.configs import TINY, composed
from tests.helpers.scenes import write_scene


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewing")
    scene = write_scene(folder / "scene", width=12, height=8)
    options = [
        "hash=C7",
        "train.steps=3",
        "train.rays=8",
        "train.eval_every=0",
        "device=cpu",
        f"store={folder / 'runs'}",
    ]
    return run(composed("scene=nerfstudio", f"scene.path={scene}", *TINY, *options)).path


@pytest.fixture(scope="session")
def trained(tiny_run: Path) -> Trained:
    return load(tiny_run)
