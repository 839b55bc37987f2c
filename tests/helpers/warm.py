"""Importing this trains two steps, after which a training imports and compiles nothing more."""

import tempfile
from pathlib import Path

import qnerf.cli.launch  # noqa: F401
from qnerf.experiment import run
from tests.helpers.configs import TINY, composed
from tests.helpers.scenes import write_scene

with tempfile.TemporaryDirectory() as folder:
    scene = ["scene=nerfstudio", f"scene.path={write_scene(Path(folder) / 'scene')}", f"store={folder}/runs"]
    budget = ["train.steps=2", "train.rays=8", "train.log_every=1", "visibility.resolution=16", "threads=1"]
    run(composed(*TINY, *scene, *budget, "hash=C7", "device=cpu"))
