import shutil

import pandas as pd
import pytest
from qnerf.analysis import load
from qnerf.analysis.pack import main
from qnerf.analysis.tables import ablation
from qnerf.analysis.verdict import evaluations

from tests.helpers.packed_stores import write_run


@pytest.fixture
def store(tmp_path):
    folder = tmp_path / "runs"
    for seed in (0, 1):
        write_run(folder, "classical", seed, [24.0 + seed, 26.0])
        write_run(folder, "qcolor", seed, [25.0 + seed, 26.5])
    write_run(folder, "qcolor", 2, state="failed")
    return folder


def test_a_packed_store_gives_the_tables_of_the_store(store, tmp_path, capsys):
    main([str(store), str(tmp_path / "packed")])
    assert capsys.readouterr().out == f"4 runs finished, 1 not, in {tmp_path / 'packed'}\n"
    tables = [ablation(load.runs(store), ["field"], baseline={"field": "classical"}).markdown()]
    shutil.rmtree(store)
    packed = load.runs(tmp_path / "packed")
    tables.append(ablation(packed, ["field"], baseline={"field": "classical"}).markdown())
    assert tables[0] == tables[1]
    assert "+0.75" in tables[1]
    assert "left out: 1 failed" in tables[1]
    assert evaluations(packed[packed["state"] == "finished"]).size == 8


def test_a_packed_folder_names_no_machine(store, tmp_path):
    main([str(store), str(tmp_path / "packed")])
    for name in ("runs", "views"):
        table = pd.read_parquet(tmp_path / "packed" / f"{name}.parquet")
        assert str(tmp_path) not in table.astype(str).to_csv()


def test_runs_are_added_to_packed_ones(store, tmp_path):
    """For example runs of another machine; a run that is there already is replaced."""
    packed, whole = tmp_path / "packed", tmp_path / "whole"
    main([str(store), str(whole)])
    main([str(store), str(packed), "--filter", "seed=0"])
    write_run(store, "qdensity", 0, [20.0, 21.0], results={"more": 1.0})
    main([str(store), str(packed), "--filter", "seed=1,2", "--add"])
    expected = [ablation(load.runs(folder, "state=finished"), ["field"]).markdown() for folder in (packed, whole)]
    assert expected[0] == expected[1]
    main([str(store), str(packed), "--filter", "field=qdensity", "--add"])
    frame = load.runs(packed)
    assert frame["run_id"].nunique() == len(frame) == 6
    assert frame["more"].count() == 1
    assert evaluations(frame[frame["state"] == "finished"]).size == 10


def test_the_records_of_studies_are_packed_and_added(store, tmp_path):
    records, packed = store / ".decisions", tmp_path / "packed"
    records.mkdir()
    for name, scene, chosen in (
        ("first", "fox", ["--filter", "seed=0"]),
        ("second", "fern", ["--filter", "seed=1", "--add"]),
    ):
        (records / f"{name}.json").write_text(f'"scene.path=/data/{scene}"')
        main([str(store), str(packed), *chosen])
    found = {path.stem: path.read_text() for path in (packed / ".decisions").iterdir()}
    assert found == {"first": '"scene.path=fox"', "second": '"scene.path=fern"'}


def test_packed_tables_do_not_hide_the_runs_of_a_store(store, tmp_path):
    main([str(store), str(tmp_path / "packed")])
    for name in ("runs.parquet", "views.parquet"):
        shutil.copy(tmp_path / "packed" / name, store)
    with pytest.raises(ValueError, match="holds runs and also packed tables"):
        load.runs(store)


def test_packed_tables_have_a_folder_of_their_own(store, tmp_path):
    run = next(store.glob("poster-*"))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    write_run(tmp_path / "other")
    for folder, told in ((run / "images", "in a run's folder"), (tmp_path / "other", "own"), (store, "own")):
        with pytest.raises(ValueError, match=told):
            main([str(store), str(folder)])
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    with pytest.raises(ValueError, match="no run of 1 is finished"):
        main([str(store), str(tmp_path / "packed"), "--filter", "state=failed"])
