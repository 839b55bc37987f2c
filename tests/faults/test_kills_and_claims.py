"""Kills and concurrent claims in real processes; QNERF_FAULTS=full runs the long form."""

import json
import os
import subprocess
import time
from pathlib import Path

import pandas as pd
import torch

from qnerf import records
from tests.helpers.jobs import STEPS, train
from tests.helpers.processes import start

FULL = os.environ.get("QNERF_FAULTS") == "full"


def jobs(*arguments: str) -> subprocess.Popen[str]:
    return start("jobs", *arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def finished(process: subprocess.Popen[str]) -> list[dict]:
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return [json.loads(line) for line in out.splitlines()]


def test_killed_at_random_moments(tmp_path: Path) -> None:
    """Every run ends with the numbers of an uninterrupted one, and readers see only whole tables."""
    runs, wanted = (50, 100) if FULL else (3, 4)  # four kills per run; some come too late
    process = jobs("kills", str(tmp_path), str(runs), "0")
    polls = 0
    try:
        while process.poll() is None:
            for directory in records.runs(tmp_path)[-2:]:
                metrics = pd.read_parquet(directory / "metrics")
                assert not metrics.duplicated(["step", "key"]).any()
                steps = metrics["step"].unique().tolist()
                assert steps == list(range(len(steps)))
                assert list(pd.read_parquet(directory / "eval.parquet").columns)[:3] == ["image", "step", "psnr"]
                assert len(pd.read_parquet(directory / "summary.parquet")) == 1
                assert records.read_status(directory)["state"] in ("running", "finished")
                polls += 1
            time.sleep(0.02)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    rounds = finished(process)
    assert polls > 10
    assert sum(line["killed"] for line in rounds) >= wanted

    claim = records.RunStore(tmp_path / "reference").claim("reference", {"seed": 0})
    assert claim.run is not None
    train(claim.run, pace=0.0)
    expected = records.read_metrics(claim.dir).drop(columns="time_s")
    assert len(expected) == 10 * STEPS
    parameters = torch.load(claim.dir / "checkpoint.pt", weights_only=True)
    for line in rounds:
        directory = tmp_path / line["run"]
        assert records.state(directory) == "finished"
        pd.testing.assert_frame_equal(records.read_metrics(directory).drop(columns="time_s"), expected)
        assert records.read_summary(directory)["psnr"] == records.read_summary(claim.dir)["psnr"]
        last = torch.load(directory / "checkpoint.pt", weights_only=True)
        assert torch.equal(last["value"], parameters["value"])
        assert torch.equal(last["random"], parameters["random"])
        assert not list(directory.rglob(".*.tmp"))


def test_one_of_several_contenders_wins(tmp_path: Path) -> None:
    count = 100 if FULL else 10
    rounds = finished(jobs("claims", str(tmp_path), str(count)))
    assert len(rounds) == 3 * count
    for line in rounds:
        won = "resumed" if line["kind"] == "stale" else "new"
        assert line["outcomes"] == sorted([won, "busy", "busy"])
        assert line["codes"] == [0, 0, 0]
    assert [records.state(directory) for directory in records.runs(tmp_path)] == ["finished"] * (3 * count)
    assert list((tmp_path / ".tmp").iterdir()) == []
