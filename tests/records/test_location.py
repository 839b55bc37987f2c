"""Where a store may be, which folders are runs, and what is deleted."""

import json
import os
from pathlib import Path

import pytest

from qnerf.records import RunStore, StoreError, find, owner
from qnerf.records.deletion import delete_run, holds_runs, is_run
from qnerf.records.location import existing_store
from tests.helpers.stores import CONFIG, claimed


@pytest.mark.parametrize("store", ["s3://bucket/runs", "http://localhost:1/x", "~/runs", "", "  ", "a\0b"])
def test_no_run_is_written_elsewhere_than_in_a_folder(tmp_path, monkeypatch, store):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="store: expected a folder") as error:
        RunStore(store)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="store: expected a folder"):
        find("a", store)
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_is_read_must_exist(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert existing_store("runs") == Path("runs")  # nobody has trained yet
    with pytest.raises(ValueError, match="/nope: no such folder"):
        existing_store(tmp_path / "nope")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="file: not a folder"):
        existing_store(tmp_path / "file")


def foreign(folder):
    """A user's folder with files of the names that a run has."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("mine: true")
    (folder / "status.json").write_text(json.dumps({"state": "finished", "run_id": folder.name}))
    (folder / "owner").mkdir()
    (folder / "owner" / "000000.json").write_text('{"name": "me"}')
    return folder


def test_a_folder_with_files_of_the_same_names_is_no_run(tmp_path):
    mine = foreign(tmp_path / "runs" / "a")
    before = {path: path.read_bytes() for path in mine.rglob("*") if path.is_file()}
    assert not is_run(mine)
    for action in (
        lambda: delete_run(mine),
        lambda: RunStore(mine.parent).claim("a", CONFIG, force=True),
    ):
        with pytest.raises(StoreError, match="a: not a run"):
            action()
    assert {path: path.read_bytes() for path in mine.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("damaged", ["status.json", "owner/000000.json"])
def test_run_with_one_record_that_a_power_cut_emptied_goes_on(store_, damaged):
    run = claimed(store_)
    run.interrupt()
    (run.dir / damaged).write_bytes(b"")
    for path in [run.dir / "status.json", *run.dir.glob("owner/*")]:
        os.utime(path, (0, 0))
    claimed(store_).finish()


def test_a_folder_is_a_store_by_one_mark(store_):
    run = claimed(store_)
    run.interrupt()
    assert is_run(run.dir)
    for path in run.dir.glob("owner/*"):
        path.unlink()
    assert is_run(run.dir)
    assert not is_run(run.dir.rename(run.dir.with_name("b")))


def test_a_folder_of_the_working_directory_is_named_as_a_path(store_, tmp_path, monkeypatch):
    claimed(store_, "proj").interrupt()
    mine = foreign(tmp_path / "here" / "proj")
    monkeypatch.chdir(mine.parent)
    assert find("proj", store_.root) == store_.root / "proj"
    assert find("./proj", store_.root).resolve() == mine
    with pytest.raises(ValueError, match="no such run; expected a folder with"):
        find("./other", store_.root)


@pytest.mark.parametrize("name", ["0000000000009.json", "000000 (1).json"])
def test_other_files_beside_the_owner_s_do_not_count(store_, name):
    run = claimed(store_)
    run.interrupt()
    (run.dir / "owner" / name).write_text("{}")
    claimed(store_).interrupt()
    assert owner.latest(run.dir)[0] == 1
    delete_run(run.dir)
    assert not run.dir.exists()


def test_links_are_neither_written_nor_deleted_through(store_, tmp_path):
    run = claimed(store_)
    run.interrupt()
    elsewhere = run.dir.rename(tmp_path / "elsewhere")
    (store_.root / "a").symlink_to(elsewhere)
    before = {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()}
    for action in (
        lambda: store_.claim("a", CONFIG),
        lambda: store_.claim("a", CONFIG, force=True),
        lambda: delete_run(store_.root / "a"),
    ):
        with pytest.raises(StoreError, match="a: is a link"):
            action()
    assert {path: path.read_bytes() for path in elsewhere.rglob("*") if path.is_file()} == before


def test_folder_that_cannot_be_looked_into_is_no_run(tmp_path):
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "status.json").symlink_to("status.json")
    assert not is_run(tmp_path / "odd")
    assert not holds_runs(tmp_path)
