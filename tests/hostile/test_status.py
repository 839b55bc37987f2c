"""A status.json and owner files that are damaged: they neither crash a reader nor block a run."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

from qnerf import records
from qnerf.records import owner
from tests.helpers.spoiled import CONFIG, interrupted, started, store


def spoil(run: Path, **values: Any) -> None:
    """Sets keys in status.json and in the owner's file."""
    for path in [run / "status.json", *run.glob("owner/*.json")]:
        path.write_text(json.dumps(json.loads(path.read_text()) | values))


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", "null", '"x"', "[" * 100_000, '{"a":' * 100_000, '{"state": {"state": "running"}}', "\x00",
     '{"state": "finished?"}', '{"state": "running"}', '{"state": 1}'],
)  # fmt: skip
def test_a_damaged_status_reads_as_interrupted(tmp_path: Path, text: str) -> None:
    run = interrupted(tmp_path)
    (run / "status.json").write_text(text)
    assert records.state(run) == "interrupted"
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.outcome == "resumed"
    assert claim.run is not None
    claim.run.finish()


@pytest.mark.parametrize("kind", ["giant", "pipe"])
def test_a_status_that_is_no_small_file(tmp_path: Path, kind: str) -> None:
    run = interrupted(tmp_path)
    path = run / "status.json"
    path.unlink()
    if kind == "giant":
        with open(path, "wb") as file:
            file.write(b'{"state": "finished"')
            file.truncate(2**40)  # a hole takes no space on the disk, but would in memory
    else:
        os.mkfifo(path)
    assert records.state(run) == "interrupted"
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.outcome == "resumed"
    assert claim.run is not None
    claim.run.finish()
    assert records.state(run) == "finished"


@pytest.mark.parametrize("pid", [1, -1, 0, 2**70, float("inf"), "../1", None, [1]])
def test_a_pid_that_is_not_the_writer_s_does_not_hold_a_run(tmp_path: Path, pid: Any) -> None:
    """Another user's process, all processes (-1), this process's group (0), not a number."""
    run = interrupted(tmp_path)
    spoil(run, state="running", pid=pid, heartbeat=0, since=0, released=False)
    for path in [run / "status.json", *run.glob("owner/*.json")]:
        os.utime(path, (0, 0))
    assert records.state(run) == "interrupted"
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.outcome == "resumed", claim.message
    assert claim.run is not None
    claim.run.finish()


def test_the_owner_is_told_in_one_printable_line(tmp_path: Path) -> None:
    run = started(tmp_path)
    spoil(run.dir, host="\x1b[2J\nroot:" + "x" * 10_000, boot="other")
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.outcome == "busy"
    assert claim.message.isprintable()
    assert len(claim.message) < len(str(run.dir)) + 200
    assert str(owner.describe(run.dir)) in claim.message
    run._stop()
