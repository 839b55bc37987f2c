"""Folders in a store may have any name."""

from pathlib import Path

import pytest

from qnerf import records
from qnerf.records import find, index
from tests.helpers.spoiled import CONFIG, interrupted, store

NAMES = [
    "-rf",
    "a b",
    "new\nline",
    "\x1b[31mred",
    "\u202eabc",
    "$(touch owned)",
    "ünï-漢字",
    "x" * 250,
    "a'\"&<b>",
    "\udcff",
]


@pytest.mark.parametrize("name", NAMES)
def test_every_folder_is_found_and_read(tmp_path: Path, name: str) -> None:
    run = interrupted(tmp_path).rename(tmp_path / "runs" / name)
    assert records.runs(tmp_path / "runs") == [run]
    assert find(name, tmp_path / "runs") == run
    assert records.state(run) == "interrupted"
    assert len(records.read_metrics(run)) == 10


@pytest.mark.parametrize("name", NAMES)
def test_a_table_of_runs_has_every_folder_whose_name_is_unicode(tmp_path: Path, name: str) -> None:
    interrupted(tmp_path).rename(tmp_path / "runs" / name)
    (tmp_path / "runs" / "other").mkdir()
    (tmp_path / "runs" / "other" / "config.yaml").write_text("seed: 0\n")
    expected = ["other"] if name == "\udcff" else sorted([name, "other"])
    assert index.load(tmp_path / "runs")["run_id"].tolist() == expected


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_s_name_is_told_in_printable_letters(tmp_path: Path, name: str) -> None:
    interrupted(tmp_path).rename(tmp_path / "runs" / name)
    with pytest.raises(ValueError, match="no such run") as error:
        find("nothing-like-it", tmp_path / "runs")
    assert str(error.value).isprintable()


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".a", ".", "..", "a b", "a" * 300, "a\n", "-a", "a\0b"])
def test_no_run_is_written_under_such_a_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="run_id: expected letters") as error:
        store(tmp_path).claim(name, CONFIG)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "runs").exists()


def test_what_else_lies_in_a_store(tmp_path: Path) -> None:
    """Files, hidden folders and broken links are not runs; an empty folder is an interrupted run."""
    run = interrupted(tmp_path)
    (run.parent / "notes.txt").write_text("x")
    (run.parent / ".hidden").mkdir()
    (run.parent / "broken").symlink_to("nowhere")
    (run.parent / "loop").symlink_to("loop")
    (run.parent / "empty").mkdir()
    assert [path.name for path in records.runs(run.parent)] == ["a", "empty"]
    assert records.state(run.parent / "empty") == "interrupted"
