"""Importing this trains two steps, after which a training imports and compiles nothing more."""

import tempfile
from pathlib import Path

import qnerf.cli.launch  # noqa: F401
from qnerf.experiment import run
from tests.helpers.configs import MOMENT, TINY, composed
from tests.helpers.scenes import write_scene

with tempfile.TemporaryDirectory() as folder:
    scene = ["scene=nerfstudio", f"scene.path={write_scene(Path(folder) / 'scene')}", f"store={folder}/runs"]
    run(composed(*scene, *TINY, *MOMENT, "threads=1"))
