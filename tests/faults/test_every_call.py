"""Writers that are killed at their system calls: at each one with QNERF_FAULTS=full, else at every 60th.

With strace the kills hit real system calls. Where it is missing or may not trace, they hit Python's audit events.
"""

import json
import os
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pandas as pd
import pytest
import torch

from qnerf import records
from tests.helpers.deaths import OPERATIONS
from tests.helpers.jobs import STEPS, train
from tests.helpers.processes import start

pytestmark = pytest.mark.skipif(os.name == "nt", reason="forks")
FULL = os.environ.get("QNERF_FAULTS") == "full"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The uninterrupted run."""
    claim = records.RunStore(tmp_path_factory.mktemp("whole"), every=60).claim("walk", {"seed": 0})
    assert claim.run is not None
    train(claim.run, pace=0.0)
    return claim.dir


@pytest.fixture(scope="module")
def shim() -> str:
    if shutil.which("strace") is None or not Path("/proc/self/status").exists():
        return "audit"
    done = subprocess.run(["strace", "-qq", "-o", os.devnull, "true"], capture_output=True, check=False)
    return "strace" if done.returncode == 0 else "audit"


def test_killed_at_every_call(tmp_path: Path, whole: Path, shim: str) -> None:
    every = 1 if FULL else 60 if shim == "strace" else 20
    process = start("deaths", str(tmp_path), str(every), shim, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, err = process.communicate(timeout=1800)
    rounds = [json.loads(line) for line in out.splitlines()]
    assert process.returncode == 0, err[-2000:]
    kills = Counter(line["operation"] for line in rounds if line["killed"])
    assert kills.keys() == OPERATIONS.keys()
    expected = records.read_metrics(whole).drop(columns="time_s")
    assert len(expected) == 10 * STEPS
    checkpoint = torch.load(whole / "checkpoint.pt", weights_only=True)
    for line in rounds:
        assert line["code"] == 0, (line, err)
        store = Path(line["store"])
        run = store / "walk"
        assert records.state(run) == "finished"
        pd.testing.assert_frame_equal(records.read_metrics(run).drop(columns="time_s"), expected, check_exact=True)
        assert records.read_summary(run)["psnr"] == records.read_summary(whole)["psnr"]
        pd.testing.assert_frame_equal(
            *(pd.read_parquet(path / "eval.parquet") for path in (run, whole)), check_exact=True
        )
        last = torch.load(run / "checkpoint.pt", weights_only=True)
        assert all(torch.equal(last[name], checkpoint[name]) for name in ("value", "random"))
        assert not list(run.rglob(".*.tmp")), line
        assert not list((store / ".tmp").glob("old-*")), line
    print(f"{shim}: {dict(kills)}")
