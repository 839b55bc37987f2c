"""Helpers that run in a process of their own, because they are killed or compete for a run."""

import os
import subprocess
import sys
from typing import Any

from tests.helpers.configs import ROOT


def start(module: str, *arguments: str, **options: Any) -> "subprocess.Popen[str]":
    """`python -m tests.helpers.<module> ARGUMENTS`, on one thread, with this checkout's package; `options` of Popen."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        [sys.executable, "-m", f"tests.helpers.{module}", *arguments],
        text=True,
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        **options,
    )
