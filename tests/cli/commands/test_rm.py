import errno
import os
from argparse import Namespace
from types import SimpleNamespace

import pytest

from qnerf.cli.commands import rm
from qnerf.records import StoreError, owner, runs
from qnerf.records.deletion import delete_run


def somebody(answer):
    """Standard input with somebody at it who answers."""
    return SimpleNamespace(isatty=lambda: True, readline=lambda: answer)


def names(store):
    return [path.name[-4:] for path in runs(store)]


def whole(store, *ends):
    """The ids of the runs that end so."""
    return [path.name for end in ends for path in runs(store) if path.name.endswith(end)]


def test_rm_with_yes_deletes_what_is_named(store, qnerf):
    done = qnerf("rm", *whole(store, "aaaa", "cccc"), "--yes")
    assert done.code == 0
    assert "finished" in done.out
    assert "failed" in done.out
    assert names(store) == ["bbbb", "eeee", "dddd"]
    assert not list(store.glob(".deleted*"))


def test_rm_asks_and_does_what_is_answered(store, qnerf, monkeypatch):
    for answer in ("n\n", ""):  # "" is Ctrl-D
        monkeypatch.setattr("sys.stdin", somebody(answer))
        done = qnerf("rm", "aaaa")
        assert (done.code, "nothing deleted" in done.out) == (1, True)
        assert "delete this run for good? [y/N]" in done.out
        assert len(names(store)) == 5
    monkeypatch.setattr("sys.stdin", somebody("y\n"))
    assert qnerf("rm", "aaaa", "bbbb").code == 0
    assert len(names(store)) == 3


def test_rm_does_not_guess_without_a_terminal(store, qnerf, monkeypatch):
    with open(os.devnull) as nobody:
        monkeypatch.setattr("sys.stdin", nobody)
        done = qnerf("rm", "aaaa")
    assert done.code == 2
    assert "--yes deletes without asking" in done.err
    assert len(names(store)) == 5


def test_a_running_run_stays_and_so_do_the_others(store, running, qnerf):
    done = qnerf("rm", *whole(store, "aaaa", "ffff"), "--yes")
    assert done.code == 2
    assert "running; stop it first; nothing deleted" in done.err
    assert len(names(store)) == 6


def test_a_run_that_somebody_takes_at_the_last_moment_stays(make):
    run = make("a")
    held = owner.acquire(run)
    with pytest.raises(StoreError, match="being written by process"):
        delete_run(run)
    assert (run / "summary.parquet").exists()
    held.release()
    delete_run(run)
    assert not run.exists()


def test_rm_keeps_what_links_lead_to(make, qnerf, tmp_path):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("x")
    run = make("a")
    (run / "images" / "link").symlink_to(outside)
    (run / "linked").symlink_to(outside / "precious")
    (run.parent / "latest").symlink_to(run)
    assert "latest: is a link" in qnerf("rm", "latest", "--yes").err
    assert qnerf("rm", "a", "--yes").code == 0
    assert (outside / "precious").read_text() == "x"


def test_a_damaged_run_can_be_deleted(store, qnerf):
    (run,) = store.glob("*-eeeeeeeeee")
    (run / "status.json").unlink()
    (run / "config.yaml").unlink()
    assert qnerf("rm", run.name, "--yes").code == 0
    assert not run.exists()


def test_the_next_one_finishes_what_a_killed_one_began(make):
    run, other = make("a"), make("b")
    left = other.rename(run.parent / ".deleted-b-1234567812345678")
    (left / "config.yaml").unlink()
    mine = run.parent / ".deleted-thesis"
    mine.mkdir()
    rm.main(Namespace(runs=[str(run)], store=str(run.parent), yes=True))
    assert [path.name for path in run.parent.iterdir()] == [mine.name]


def test_a_full_disk_does_not_keep_runs_from_being_deleted(make, monkeypatch):
    run = make("a")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(owner, "create", full)
    delete_run(run)
    assert not run.exists()


def test_an_empty_name_does_not_delete_a_linked_store(make, qnerf, tmp_path):
    store = make("a").parent
    store.rename(tmp_path / "scratch")
    store.symlink_to(tmp_path / "scratch")
    assert qnerf("rm", "", "--yes").code == 2
    assert store.is_symlink()


def test_rm_by_a_part_of_an_id_needs_a_question(make, qnerf):
    """The second of two equal commands must not delete the copy that the user has made of the run."""
    run = make("proj-s0-1234")
    copy = run.rename(run.parent / "proj-s0-1234-backup")
    done = qnerf("rm", "proj-s0-1234", "--yes")
    assert done.code == 2
    assert "expected a whole id, such as proj-s0-1234-backup" in done.err
    assert copy.is_dir()
