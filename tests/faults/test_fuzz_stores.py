"""Mutated stores through the console commands; QNERF_FAULTS=full runs 5,000 of them."""

import os
import subprocess
import sys

import pytest

from tests.helpers.configs import ROOT

FULL = os.environ.get("QNERF_FAULTS") == "full"
CASES = 5000 if FULL else 8

FAILED: tuple[str, ...] = ()
"""Every case that failed once, as the fuzzer printed it: `SEED NAME:NUMBER ...`."""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the fuzzer watches its processes through /proc")
def test_no_mutated_store_ends_a_command_badly() -> None:
    arguments = [f"--case={case}" for case in FAILED]
    done = subprocess.run(
        [sys.executable, "-m", "tests.faults.fuzz_stores", f"--cases={CASES}", *arguments],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{done.stdout}{done.stderr[-4000:]}"
    assert f"{CASES + len(FAILED)} cases, 0 failed" in done.stdout
