"""Nothing mixes the CPU with another device, as far as a machine without one can tell."""

import subprocess
import sys

import pytest
from torch.utils import backend_registration

from tests.helpers.configs import ROOT


def test_the_layer_and_a_training_step_stay_on_their_device() -> None:
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip("this PyTorch cannot register a device from Python")
    command = [sys.executable, "-m", "tests.helpers.fake_accelerator", "qcolor"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    lines = done.stdout.split("\n")
    assert {"qiren 2 0.1", "lightcone", "qcolor", "done"} <= set(lines), done.stderr[-2000:]
