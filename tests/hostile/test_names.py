"""Folders in a store may have any name."""

import pytest

from qnerf import records
from qnerf.config.identity import is_unicode
from qnerf.records import RunStore, details, find, index
from tests.helpers.stores import CONFIG, claimed

NAMES = ["-rf", "a b", "new\nline", "\x1b[31mred", "\u202eabc", "$(touch owned)", "ünï-漢字", "x" * 250, "a'\"&<b>"]


def test_folders_of_any_name_are_found_read_and_told(tmp_path):
    root = tmp_path / "runs"
    started = claimed(RunStore(root))
    started.log(1, 0.0, {"loss": 1.0})
    started.interrupt()
    run = started.dir
    for name in NAMES:
        run = run.rename(root / name)
        assert records.runs(root) == [run]
        assert find(name, root) == run
        assert len(records.read_metrics(run)) == 1
        assert index.load(root)["run_id"].tolist() == [name]
        with pytest.raises(ValueError, match="no such run") as error:
            find("nothing-like-it", root)
        assert str(error.value).isprintable()


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".a", ".", "..", "a b", "a" * 300, "a\n", "-a", "a\0b"])
def test_a_hostile_name_is_no_run_s(tmp_path, name):
    with pytest.raises(ValueError, match="run_id: expected letters") as error:
        RunStore(tmp_path / "runs").claim(name, CONFIG)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "runs").exists()


def test_a_store_ignores_what_else_lies_in_it(tmp_path):
    """Files, hidden folders and broken links are not runs; an empty folder is an interrupted run."""
    run = tmp_path / "runs" / "a"
    claimed(RunStore(run.parent)).interrupt()
    (run.parent / "notes.txt").write_text("x")
    (run.parent / ".hidden").mkdir()
    (run.parent / "broken").symlink_to("nowhere")
    (run.parent / "loop").symlink_to("loop")
    (run.parent / "empty").mkdir()
    assert [path.name for path in records.runs(run.parent)] == ["a", "empty"]
    assert records.state(run.parent / "empty") == "interrupted"


def test_text_that_is_not_utf8_is_one_damaged_row_or_refused_where_it_comes_in(tmp_path):
    for name in ("a", "b"):
        claimed(RunStore(tmp_path), name).finish()
    with pytest.raises(ValueError, match="expected a folder whose name is UTF-8"):
        index.load("gr\udcfcn")
    (tmp_path / "b").rename(tmp_path / "gr\udcfcn")
    frame = index.load(tmp_path)
    assert frame["state"].tolist() == ["finished", "damaged"]
    assert frame["error"][1] == "gr\\udcfcn: expected a folder whose name is UTF-8; rename it"
    assert all(is_unicode(str(value)) for value in frame.drop(columns="path").to_numpy().ravel())
    (tmp_path / "a" / "status.json").write_text('{"state": "finished", "error": "\\uDCFC"}')
    assert index.load(tmp_path)["state"].tolist() == ["damaged", "damaged"]


def test_a_path_that_is_not_utf8_has_question_marks_in_a_run(tmp_path):
    claim = RunStore(tmp_path).claim("a", {**CONFIG, "label": "gr\udcfcn"}, ["scene.path=gr\udcfcn"])
    claim.run.write_environment({"command": ["gr\udcfcn"]})
    claim.run.finish()
    assert details.read(claim.dir)["problems"] == []
    assert details.read(claim.dir)["overrides"] == ["scene.path=gr?n"]
    assert details.read(claim.dir)["environment"] == {"command": ["gr?n"]}
