"""Nothing is read or written through a link in a run's folder."""

from pathlib import Path

import pytest

from qnerf import records
from qnerf.cli import main
from qnerf.records import StoreError, annotations, files, find, owner
from qnerf.records.deletion import delete_run
from tests.helpers.packed_stores import write_run
from tests.helpers.spoiled import CONFIG, interrupted, store

READERS = {
    "config.yaml": records.read_config,
    "summary.parquet": records.read_summary,
    "metrics/part-00000.parquet": records.read_metrics,
    "metrics": records.read_metrics,
}


def lead_away(run: Path, name: str, outside: Path) -> dict[Path, bytes]:
    """Moves a file or folder out of the run and puts a link in its place. Returns the files outside."""
    outside.mkdir()
    (run / name).rename(outside / Path(name).name)
    (run / name).symlink_to(outside / Path(name).name)
    return contents(outside)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


@pytest.mark.parametrize("name", READERS)
def test_nothing_is_read_through_a_link(tmp_path: Path, name: str) -> None:
    run = interrupted(tmp_path)
    lead_away(run, name, tmp_path / "outside")
    with pytest.raises(StoreError, match="is a link") as error:
        READERS[name](run)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["owner", "metrics", "images"])
def test_nothing_is_written_through_a_linked_folder(tmp_path: Path, name: str) -> None:
    run = interrupted(tmp_path)
    before = lead_away(run, name, tmp_path / "outside")
    with pytest.raises(StoreError, match=f"{name}: is a link"):
        store(tmp_path).claim("a", CONFIG)
    assert contents(tmp_path / "outside") == before


def test_a_run_that_is_a_link_is_not_written(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    before = lead_away(run.parent, "a", tmp_path / "outside")
    with pytest.raises(StoreError, match="a: is a link"):
        store(tmp_path).claim("a", CONFIG)
    assert contents(tmp_path / "outside") == before
    assert records.runs(run.parent) == []
    with pytest.raises(StoreError, match="a: is a link"):
        records.read_metrics(run)
    with pytest.raises(StoreError, match="a: is a link"):
        find("a", run.parent)
    with pytest.raises(ValueError, match=r"a link to .*; name that folder itself"):
        find(str(run))  # its path may be typed without looking


@pytest.mark.parametrize("name", ["status.json", "config.yaml", "summary.parquet", "eval.parquet", "checkpoint.pt"])
def test_a_linked_file_is_replaced_not_written(tmp_path: Path, name: str) -> None:
    run = interrupted(tmp_path)
    before = lead_away(run, name, tmp_path / "outside")
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.run is not None
    claim.run.resume(9)
    claim.run.write_eval([{"image": "a", "psnr": 20.0}])
    claim.run.save_checkpoint({"step": 9})
    claim.run.finish()
    assert contents(tmp_path / "outside") == before
    assert not (run / name).is_symlink()


def test_a_linked_log_is_not_appended_to(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    (tmp_path / "profile").write_text("mine\n")
    (run / "log.txt").symlink_to(tmp_path / "profile")
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.run is not None
    with pytest.raises(StoreError, match=r"log\.txt: is a link"):
        claim.run.text_log("hello")
    claim.run.finish()
    assert (tmp_path / "profile").read_text() == "mine\n"


def test_deletion_does_not_follow_the_store_s_folder_for_deleted_runs(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    precious = tmp_path / "outside" / "old-a-12345678" / "owner"
    precious.mkdir(parents=True)
    (run.parent / ".tmp").rmdir()
    (run.parent / ".tmp").symlink_to(tmp_path / "outside")
    for action in (lambda: delete_run(run), lambda: store(tmp_path).claim("a", CONFIG)):
        with pytest.raises(StoreError, match=r"\.tmp: is a link"):
            action()
    assert precious.is_dir()
    assert (run / "config.yaml").exists()


@pytest.mark.parametrize("name", ["owner", ".annotations"])
def test_owner_files_behind_a_link_stay(tmp_path: Path, name: str) -> None:
    run = interrupted(tmp_path)
    annotations.write_note(run, "x")
    before = lead_away(run, name, tmp_path / "outside")
    actions = [lambda: annotations.write_note(run, "y"), lambda: owner.acquire(run if name == "owner" else run / name)]
    for action in [lambda: delete_run(run), *actions] if name == "owner" else actions:
        with pytest.raises(StoreError, match=f"{name}: is a link"):
            action()
    assert contents(tmp_path / "outside") == before


@pytest.mark.parametrize("name", ["images", "metrics"])
def test_folders_and_files_that_are_links_are_not_listed(tmp_path: Path, name: str) -> None:
    run = interrupted(tmp_path)
    (tmp_path / "secret").write_text("x")
    (run / name / "link").symlink_to(tmp_path / "secret")
    assert run / name / "link" not in files.files_in(run / name)
    lead_away(run, name, tmp_path / "outside")
    with pytest.raises(StoreError, match=f"{name}: is a link"):
        files.files_in(run / name)


def test_the_store_itself_may_be_a_link(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    run.parent.rename(tmp_path / "scratch")
    run.parent.symlink_to(tmp_path / "scratch")
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.run is not None
    claim.run.resume(9)
    claim.run.finish()
    assert records.runs(run.parent) == [run]
    assert len(records.read_metrics(run)) == 10
    delete_run(run)
    assert records.runs(run.parent) == []


def test_a_folder_swapped_after_the_check_is_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run's folder becomes a link when its file has been written and is about to be renamed."""
    run = interrupted(tmp_path)
    outside = tmp_path / "outside"
    outside.mkdir()

    def swap(_: Path) -> None:
        run.rename(tmp_path / "moved")
        run.symlink_to(outside)

    files.replace(run / "status.json", b"{}", before_rename=swap)
    assert list(outside.iterdir()) == []
    assert (tmp_path / "moved" / "status.json").read_bytes() == b"{}"


@pytest.mark.parametrize("name", ["status.json", "metrics/part-00000.parquet"])
def test_a_system_without_descriptors_refuses_links_too(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_DESCRIPTORS", False)
    run = interrupted(tmp_path)
    assert files.read_bytes(run / name, 10**6)
    files.replace(run / "status.json", b"{}")
    before = lead_away(run, name, tmp_path / "outside")
    with pytest.raises(StoreError, match="is a link"):
        files.read_bytes(run / name, 10**6)
    assert contents(tmp_path / "outside") == before


def test_leftovers_that_are_links_go_without_what_they_lead_to(tmp_path: Path) -> None:
    run = interrupted(tmp_path)
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "precious").write_text("x")
    (run / ".x.tmp").symlink_to(tmp_path / "outside")
    (run.parent / ".tmp" / "old-a-00000000").symlink_to(tmp_path / "outside")
    claim = store(tmp_path).claim("a", CONFIG)
    assert claim.run is not None
    claim.run.finish()
    assert (tmp_path / "outside" / "precious").read_text() == "x"


@pytest.mark.parametrize(
    "arguments",
    [
        ["show", "./loop"], ["diff", "./loop", "./loop"], ["tag", "./loop", "x"], ["export", "./loop", "--to=csv"],
        ["export", "RUN", "--to=csv", "--out=loop"], ["resume", "./loop"], ["reproduce", "./loop"],
        ["pack", "STORE", "loop"], ["figures", "STORE", "capacity", "--out=loop"],
    ],
)  # fmt: skip
def test_a_link_to_itself_is_one_line(tmp_path, monkeypatch, capsys, arguments):
    run = write_run(tmp_path / "runs")
    (tmp_path / "loop").symlink_to("loop")
    monkeypatch.chdir(tmp_path)
    command, *rest = [{"RUN": str(run), "STORE": str(run.parent)}.get(word, word) for word in arguments]
    assert main.dispatch(command, rest) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
