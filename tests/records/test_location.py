"""Where a store may be, and which folders are runs."""

import json
import os
from pathlib import Path

import pytest

from qnerf.records import RunStore, StoreError, annotations, find
from qnerf.records.deletion import delete_run, is_run
from qnerf.records.location import existing_store, store_folder
from qnerf.records.numbered import OWNERS, PARTS
from tests.helpers.stores import CONFIG, claimed


@pytest.mark.parametrize("store", ["s3://bucket/runs", "http://localhost:1/x", "", "  ", "a\0b"])
def test_no_run_is_written_elsewhere_than_in_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, store: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="store: expected a folder") as error:
        RunStore(store)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="store: expected a folder"):
        find("a", store)
    assert list(tmp_path.iterdir()) == []


def test_a_store_that_is_read_must_exist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert existing_store("runs") == Path("runs")  # nobody has trained yet
    assert store_folder(f"file://{tmp_path}/new") == tmp_path / "new"
    with pytest.raises(ValueError, match="/nope: no such folder"):
        existing_store(tmp_path / "nope")
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="file: not a folder"):
        existing_store(tmp_path / "file")


def foreign(folder: Path) -> Path:
    """A user's folder with files of the names that a run has."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("mine: true")
    (folder / "status.json").write_text(json.dumps({"state": "finished", "run_id": folder.name}))
    (folder / "owner").mkdir()
    (folder / "owner" / "000000.json").write_text('{"name": "me"}')
    return folder


def test_a_folder_with_files_of_the_same_names_is_no_run(tmp_path: Path) -> None:
    mine = foreign(tmp_path / "runs" / "a")
    before = {path: path.read_bytes() for path in mine.rglob("*") if path.is_file()}
    assert not is_run(mine)
    for action in (
        lambda: delete_run(mine),
        lambda: annotations.write_note(mine, "x"),
        lambda: RunStore(mine.parent).claim("a", CONFIG, force=True),
    ):
        with pytest.raises(StoreError, match="a: not a run"):
            action()
    assert {path: path.read_bytes() for path in mine.rglob("*") if path.is_file()} == before


def test_a_run_whose_records_a_power_cut_emptied_goes_on(store_: RunStore) -> None:
    run = claimed(store_)
    run.interrupt()
    for path in [run.dir / "status.json", *run.dir.glob("owner/*")]:
        path.write_bytes(b"")
        os.utime(path, (0, 0))
    claimed(store_).finish()


def test_one_mark_is_enough(store_: RunStore) -> None:
    run = claimed(store_)
    run.interrupt()
    assert is_run(run.dir)
    status = json.loads((run.dir / "status.json").read_text())
    del status["format"], status["config"]  # the first version wrote neither
    (run.dir / "status.json").write_text(json.dumps(status))
    for path in run.dir.glob("owner/*"):
        path.unlink()
    assert is_run(run.dir)
    assert not is_run(run.dir.rename(run.dir.with_name("b")))


def test_a_folder_of_the_working_directory_is_named_as_a_path(
    store_: RunStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    claimed(store_, "proj").interrupt()
    mine = foreign(tmp_path / "here" / "proj")
    monkeypatch.chdir(mine.parent)
    assert find("proj", store_.root) == store_.root / "proj"
    assert find("./proj", store_.root).resolve() == mine
    with pytest.raises(ValueError, match="no such run; expected a folder with"):
        find("./other", store_.root)


@pytest.mark.parametrize(
    "name",
    [
        "part-00000 (1).parquet",
        "part-0.parquet",
        "part-000000.parquet",
        "part-\u0660\u0660\u0660\u0660\u0660.parquet",
        "part-.parquet",
        "part-1000000000.parquet",
        f"part-{'9' * 200}.parquet",
        "xpart-00000.parquet",
    ],
)
def test_a_number_has_one_name(name: str) -> None:
    assert PARTS.number(name) is None
    assert PARTS.number("part-100000.parquet") == 100000


@pytest.mark.parametrize("name", ["0000000000009.json", "\u0660\u0660\u0660\u0660\u0660\u0669.json", "000000 (1).json"])
def test_other_files_beside_the_owner_s_do_not_count(store_: RunStore, name: str) -> None:
    run = claimed(store_)
    run.interrupt()
    (run.dir / "owner" / name).write_text("{}")
    claimed(store_).interrupt()
    assert list(OWNERS.in_folder(run.dir / "owner")) == [1]
    delete_run(run.dir)
    assert not run.dir.exists()


def test_the_last_number_is_told(store_: RunStore) -> None:
    run = claimed(store_)
    run.interrupt()
    (run.dir / "owner" / "999999999.json").write_text(next(run.dir.glob("owner/*.json")).read_text())
    with pytest.raises(StoreError, match="owner: there is no number after 999999999; delete this folder"):
        store_.claim("a", CONFIG)
