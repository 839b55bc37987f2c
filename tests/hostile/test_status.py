"""A status.json and owner files from elsewhere: they neither crash a reader nor block a run."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf import records
from qnerf.records import owner
from tests.helpers.spoiled import CONFIG, interrupted, started, store

plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)
KEYS = ("state", "step", "heartbeat", "pid", "host", "boot", "started", "claim", "error", "format", "created", "nonce",
        "since", "released", "config")  # fmt: skip


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


@pytest.mark.parametrize("kind", ["giant", "link", "pipe", "folder"])
def test_a_status_that_is_no_small_file(tmp_path: Path, kind: str) -> None:
    run = interrupted(tmp_path)
    path = run / "status.json"
    path.unlink()
    if kind == "giant":
        with open(path, "wb") as file:
            file.write(b'{"state": "finished"')
            file.truncate(2**40)  # a hole takes no space on the disk, but would in memory
    elif kind == "link":
        (tmp_path / "elsewhere.json").write_text('{"state": "finished"}')
        path.symlink_to(tmp_path / "elsewhere.json")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()
        assert records.read_status(run) == {}
        return
    assert records.state(run) == "interrupted"
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.outcome == "resumed"
    assert claim.run is not None
    claim.run.finish()
    assert records.state(run) == "finished"
    if kind == "link":
        assert (tmp_path / "elsewhere.json").read_text() == '{"state": "finished"}'


@pytest.mark.parametrize("pid", [1, -1, 0, 2**70, 1e308, float("inf"), float("nan"), "1", "../1", None, True, [1], {}])
def test_a_pid_that_is_not_the_writer_s_does_not_hold_a_run(tmp_path: Path, pid: Any) -> None:
    """Another user's process, all processes (-1), this process's group (0), not a number."""
    run = interrupted(tmp_path)
    spoil(run, state="running", pid=pid, heartbeat=0, since=0, released=False)
    for path in run.glob("owner/*.json"):
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


@settings(max_examples=40)
@given(st.dictionaries(st.sampled_from(KEYS), plain))
def test_any_values_are_survived(tmp_path_factory: pytest.TempPathFactory, values: dict[str, Any]) -> None:
    tmp_path = tmp_path_factory.mktemp("store")
    run = interrupted(tmp_path)
    spoil(run, **values)
    assert records.state(run) in records.read.STATES
    try:
        claim = store(tmp_path).claim("a", CONFIG)
    except records.StoreError as error:
        assert "newer qnerf" in str(error)  # noqa: PT017
        return
    assert claim.outcome in ("resumed", "finished", "busy")
    if claim.run is not None:
        claim.run.finish()
        assert records.state(run) == "finished"
