"""One owner per run, whatever clocks, pids and late contenders do."""

import json
import os
import platform
import re
import time

import pytest

from qnerf import records
from qnerf.records import StoreError, owner
from tests.helpers.stores import CONFIG, claimed, vanish


def test_a_living_owner_is_respected(store_):
    run = claimed(store_)
    claim = store_.claim("a", CONFIG)
    assert (claim.outcome, claim.run) == ("busy", None)
    expected = rf"already being written by process {os.getpid()} on {platform.node()} \(last heartbeat \d+ s ago\)"
    assert re.search(expected, claim.message)
    run.finish()


def test_a_recycled_pid_is_not_the_owner(store_):
    run = claimed(store_)
    assert records.state(run.dir) == "running"
    vanish(run)  # our own pid, which lives, with another start time
    assert records.state(run.dir) == "interrupted"
    again = store_.claim("a", CONFIG)
    assert again.outcome == "resumed"
    assert "was interrupted, going on from the start" in again.message
    again.run.finish()


def test_an_owner_may_let_go_twice(store_):
    own = claimed(store_)._ownership
    own.release()
    own.release()
    assert store_.claim("a", CONFIG).outcome == "resumed"


def test_the_next_owner_removes_what_a_killed_claim_left(store_):
    run = claimed(store_)
    run.interrupt()
    left = run.dir / "owner" / ".000001.json.0a.tmp"
    left.write_text("{}")
    claimed(store_).interrupt()
    assert not left.exists()


def test_a_contender_whose_file_the_owner_removes_finds_the_run_owned(store_, monkeypatch):
    run = claimed(store_)
    run.interrupt()
    link, winners = os.link, []

    def slow(*arguments, **options):  # the other process is faster, and tidies
        monkeypatch.undo()
        winners.append(claimed(store_))
        link(*arguments, **options)

    monkeypatch.setattr(os, "link", slow)
    assert store_.claim("a", CONFIG).outcome == "busy"
    winners[0].interrupt()


def elsewhere(run, age):
    """Leaves the run as a process on another machine would have, `age` seconds ago by its own clock."""
    vanish(run, host="other", boot="other", heartbeat=time.time() - age)


def last_written(run, age):
    """Sets the times of the owner's files, `age` seconds ago by the clock of the file system."""
    for path in [run.dir / "status.json", *run.dir.glob("owner/*.json")]:
        os.utime(path, (time.time() - age, time.time() - age))


@pytest.mark.parametrize("ahead", [0, 3600, -3600])
def test_run_of_another_machine_lives_by_the_clock_of_the_file_system(store_, monkeypatch, ahead):
    """Whether the clocks of both machines are right or not."""
    run = claimed(store_)
    elsewhere(run, ahead)
    clock = time.time
    for age, alive in ((1, True), (170, True), (190, False)):
        last_written(run, age)
        with monkeypatch.context() as patch:
            patch.setattr(time, "time", lambda: clock() + ahead)
            assert records.state(run.dir) == ("running" if alive else "interrupted")
            said = re.search(r"on other \(last heartbeat (\d+) s ago\)", str(owner.describe(run.dir)))
            assert age <= int(said[1]) < age + 60
            claim = store_.claim("a", CONFIG)
            assert claim.outcome == ("busy" if alive else "resumed")
    claim.run.finish()


def test_a_writer_that_was_succeeded_stops(store_):
    first = claimed(store_)
    first.log(0, 0.0, {"loss": 1.0})
    mine = next(first.dir.glob("owner/*.json"))
    record = json.loads(mine.read_text())
    mine.write_text(json.dumps(record | {"started": "1"}))
    second = claimed(store_)
    for write in (first.flush, lambda: first.save_checkpoint({}), lambda: first.write_eval([])):
        with pytest.raises(StoreError, match="taken over by another process"):
            write()
    with pytest.raises(StoreError, match="taken over"):
        first.finish()
    assert records.state(second.dir) == "running"
    second.finish()


def test_a_late_contender_does_not_become_a_second_owner(store_):
    """It found owner n dead, slept, and asks for n + 1 when n + 2 owns the run already."""
    run = claimed(store_)
    run.interrupt()
    stale = owner.latest(run.dir)[1]
    claimed(store_).interrupt()
    last = claimed(store_)
    late = owner.create_owner(run.dir, 1)
    assert late is not None
    assert not owner._succeeds(run.dir, late, stale)
    last.flush()
    last.finish()


def test_an_owner_that_was_frozen_while_it_wrote_does_not_rename(store_, monkeypatch):
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})

    def frozen(_):
        """While it waits for the disk, another machine takes the run over."""
        monkeypatch.undo()
        assert owner.create_owner(run.dir, 1) is not None

    monkeypatch.setattr(os, "fsync", frozen)
    with pytest.raises(StoreError, match="taken over"):
        run.flush()
    assert len(records.read_metrics(run.dir)) == 0
    run._stop()
