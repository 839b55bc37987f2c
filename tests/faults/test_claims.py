"""Concurrent claims in real processes; QNERF_FAULTS=full runs the long form."""

import json
import os
import subprocess
from pathlib import Path

from qnerf import records
from tests.helpers.processes import start

FULL = os.environ.get("QNERF_FAULTS") == "full"


def test_a_claim_is_won_by_one_of_several(tmp_path: Path) -> None:
    count = 100 if FULL else 10
    process = start("jobs", str(tmp_path), str(count), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    rounds = [json.loads(line) for line in out.splitlines()]
    assert len(rounds) == 3 * count
    for line in rounds:
        won = "resumed" if line["kind"] == "stale" else "new"
        assert line["outcomes"] == sorted([won, "busy", "busy"])
        assert line["codes"] == [0, 0, 0]
    assert [records.state(directory) for directory in records.runs(tmp_path)] == ["finished"] * (3 * count)
