"""One owner per run, whatever clocks, pids and late contenders do."""

import json
import os
import threading
import time
from pathlib import Path

import pytest

from qnerf import records
from qnerf.records import Run, RunStore, StoreError, owner
from tests.helpers.stores import CONFIG, claimed, vanish


def test_a_living_owner_is_respected(store_: RunStore) -> None:
    run = claimed(store_)
    claim = store_.claim("a", CONFIG)
    assert (claim.outcome, claim.run) == ("busy", None)
    assert claim.owner is not None
    assert claim.owner.pid == os.getpid()
    assert f"already being written by process {os.getpid()} on this machine" in claim.message
    run.finish()


def test_a_recycled_pid_is_not_the_owner(store_: RunStore) -> None:
    run = claimed(store_)
    assert records.state(run.dir) == "running"
    vanish(run)  # our own pid, which lives, with another start time
    assert records.state(run.dir) == "interrupted"
    again = store_.claim("a", CONFIG)
    assert again.outcome == "resumed"
    assert "was interrupted, going on from the start" in again.message
    assert again.run is not None
    again.run.finish()


def elsewhere(run: Run, age: float) -> None:
    """Leaves the run as a process on another machine would have, `age` seconds ago."""
    run._stop()
    run._closed = True
    for path in [run.dir / "status.json", *run.dir.glob("owner/*.json")]:
        record = json.loads(path.read_text()) | {"host": "other", "boot": "other", "heartbeat": time.time() - age}
        path.write_text(json.dumps(record))


@pytest.mark.parametrize(("age", "alive"), [(1, True), (-20, True), (1000, False), (-1000, False)])
def test_a_run_elsewhere_lives_by_its_heartbeat(store_: RunStore, age: float, alive: bool) -> None:
    run = claimed(store_)
    elsewhere(run, age)
    assert records.state(run.dir) == ("running" if alive else "interrupted")
    claim = store_.claim("a", CONFIG)
    assert claim.outcome == ("busy" if alive else "resumed")
    if claim.run is not None:
        claim.run.finish()


def test_a_clock_that_is_off_does_not_lose_a_run_to_another_machine(tmp_path: Path) -> None:
    store = RunStore(tmp_path, every=60, watch=30)
    run = claimed(store)
    elsewhere(run, 1000)

    def beat() -> None:
        time.sleep(0.3)
        elsewhere(run, 990)

    thread = threading.Thread(target=beat)
    thread.start()
    claim = store.claim("a", CONFIG)
    thread.join()
    assert claim.outcome == "busy"
    assert "on other" in claim.message


def test_a_clock_set_back_changes_nothing_here(store_: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now - 1e6)
    run.status(step=1)
    assert records.state(run.dir) == "running"
    assert store_.claim("a", CONFIG).outcome == "busy"
    monkeypatch.undo()
    assert records.state(run.dir) == "running"
    run.finish()
    assert records.state(run.dir) == "finished"


def test_a_writer_that_was_succeeded_stops(store_: RunStore) -> None:
    first = claimed(store_)
    first.log(0, 0.0, {"loss": 1.0})
    mine = next(first.dir.glob("owner/*.json"))
    record = json.loads(mine.read_text())
    mine.write_text(json.dumps(record | {"started": "1"}))
    second = claimed(store_)
    for write in (first.flush, first.status, lambda: first.save_checkpoint({}), lambda: first.write_eval([])):
        with pytest.raises(StoreError, match="taken over by another process"):
            write()
    with pytest.raises(StoreError, match="taken over"):
        first.finish()
    assert records.state(second.dir) == "running"
    second.finish()


def test_a_late_contender_does_not_become_a_second_owner(store_: RunStore) -> None:
    """It found owner n dead, slept, and asks for n + 1 when n + 2 owns the run already."""
    run = claimed(store_)
    run.interrupt()
    stale = owner.latest(run.dir)[1]
    claimed(store_).interrupt()
    last = claimed(store_)
    late = owner.create(run.dir, 1)
    assert late is not None
    assert not owner._succeeds(run.dir, late, stale)
    last.flush()
    last.finish()
