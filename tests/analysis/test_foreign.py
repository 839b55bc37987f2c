"""Tables of runs that other programs wrote."""

import json
import sqlite3

import numpy as np
import pandas as pd
import pytest
from qnerf.analysis import foreign, load, selection
from qnerf.analysis.figures.__main__ import main as draw
from qnerf.analysis.report.__main__ import main as report
from qnerf.analysis.serve.answers import Answers
from qnerf.analysis.serve.store import WatchedStore
from qnerf.analysis.tables.__main__ import main as tables

from qnerf import metrics
from qnerf.records import filters

SETTINGS = [(data, model, width) for data in ("digits", "wine") for model in ("mlp", "kan") for width in (8, 16)]


@pytest.fixture(autouse=True)
def _undeclared(monkeypatch):
    monkeypatch.setattr(metrics, "METRICS", dict(metrics.METRICS))
    monkeypatch.setattr(foreign, "METRICS", metrics.METRICS)
    monkeypatch.setattr(foreign, "NAMED", set())
    monkeypatch.setattr(selection, "NAMED", foreign.NAMED)
    monkeypatch.setattr(filters, "ALIASES", dict(filters.ALIASES))


@pytest.fixture
def table():
    random = np.random.default_rng(0)
    rows = [
        {"Name": f"run {n}-{seed}", "State": "finished", "dataset": data, "model": model, "width": width}
        | {"my.seed": seed, "Runtime": 1 + random.random(), "val.acc": (model == "kan") + 0.01 * random.random()}
        | {"val.loss": random.random(), "host": "ab"[seed % 2]}
        for n, (data, model, width) in enumerate(SETTINGS)
        for seed in range(4)
    ]
    rows[-1]["State"] = "crashed"
    return pd.DataFrame(rows)


def test_settings_metrics_and_seed_are_guessed_and_said(table, capsys):
    frame = load.runs(table, "model=kan seed<3 dataset=wine")
    assert capsys.readouterr().err == (
        "table: 32 runs; settings model, width; seed my.seed; scene dataset; metrics val/acc, val/loss, Runtime "
        "(less is better: val/loss, Runtime)\n"
    )
    assert (len(frame), set(frame["scene_name"]), frame["run_id"].iloc[0]) == (6, {"wine"}, "run 6-0")
    whole = load.runs(table)
    assert whole["state"].value_counts().to_dict() == {"finished": 31, "failed": 1}
    assert selection.main_metric(whole) == "val/acc"
    assert selection.row_keys(selection.select(whole, "val/acc").runs) == ["scene_name", "model", "width"]


def test_columns_can_be_named(table, capsys):
    frame = load.runs(table, metrics=["val.loss"], settings=["model", "width", "host"], seed="my.seed")
    assert "settings model, width, host; seed my.seed; scene dataset; metrics val/loss" in capsys.readouterr().err
    assert "val/acc" not in frame
    with pytest.raises(ValueError, match="no run has a column 'lr'"):
        load.runs(table, metrics=["lr"])
    with pytest.raises(ValueError, match="no number differs between runs of equal settings; --metrics names results"):
        load.runs(table[["dataset", "model", "width", "my.seed"]])


def test_a_run_that_is_listed_twice_counts_once(table, capsys):
    again = table.iloc[:5].assign(Name=[f"copy {n}" for n in range(5)])
    assert len(load.runs(pd.concat([table, again]))) == len(table)
    assert "; metrics val/acc, val/loss, Runtime; 5 repeated rows left out (" in capsys.readouterr().err


def test_a_table_goes_through_tables_figures_report_and_page(table, tmp_path, capsys):
    file = tmp_path / "results.csv"
    table.to_csv(file, index=False)
    judged = ["--baseline", "model=mlp,width=8"]
    tables([str(file), *judged, "--format", "csv"])
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) == 9
    draw([str(file), "forest", "--out", str(tmp_path), "--formats", "png", *judged])
    assert (tmp_path / "forest.png").exists()
    report([str(file), "--out", str(tmp_path / "page.html"), *judged, "--within", "0.1"])
    page = (tmp_path / "page.html").read_text()
    assert "kan, 8: <strong>better *</strong>" in page
    assert "mlp, 16: <strong>equivalent" in page
    live = Answers(WatchedStore(file))
    assert live.page()["data"]["total"] == 32
    assert live.differences("", "", "model=mlp,width=8", "val/acc").table.text["verdict"].str.startswith("better").any()


def test_trackio_keeps_runs_in_a_database(table, tmp_path, capsys):
    file = tmp_path / "project.db"
    with sqlite3.connect(file) as database:
        database.execute("CREATE TABLE configs (run_name TEXT, config TEXT)")
        database.execute("CREATE TABLE metrics (id INTEGER, run_name TEXT, metrics TEXT)")
        for row in table[table["dataset"] == "wine"].to_dict("records"):
            config = {"model": row["model"], "width": str(row["width"]), "seed": row["my.seed"], "_Group": None}
            database.execute("INSERT INTO configs VALUES (?, ?)", [row["Name"], json.dumps(config)])
            for number, value in enumerate((0.0, row["val.acc"])):
                logged = [number, row["Name"], json.dumps({"acc": value, "note": "text"})]
                database.execute("INSERT INTO metrics VALUES (?, ?, ?)", logged)
    frame = load.runs(file)
    assert "16 runs; settings model, width; seed seed; metrics acc" in capsys.readouterr().err
    np.testing.assert_array_equal(frame["acc"], table.loc[table["dataset"] == "wine", "val.acc"])


def test_what_is_no_table_is_refused_in_a_line(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"a\.csv: no such file"):
        load.runs(tmp_path / "a.csv")
    sqlite3.connect(tmp_path / "b.db").close()
    with pytest.raises(ValueError, match=r"b\.db: expected a database of MLflow or Trackio"):
        load.runs(tmp_path / "b.db")
    (tmp_path / "mlruns" / "0").mkdir(parents=True)
    (tmp_path / "mlruns" / "0" / "meta.yaml").touch()
    monkeypatch.setitem(__import__("sys").modules, "mlflow", None)
    with pytest.raises(ValueError, match="pip install mlflow"):
        load.runs(tmp_path / "mlruns")
    with pytest.raises(ValueError, match="seed: a store of qnerf knows this"):
        load.runs(tmp_path, seed="seed")


def test_of_two_seeds_the_one_that_varies_counts_and_a_result_may_repeat(capsys):
    """As a public table of language models has them: a corpus of one seed, and an accuracy that is often 0."""
    rows = [
        {"corpus_seed": 1, "training_seed": seed, "drop": dropout, "test_accuracy": float(seed > 2), "loss": seed / 7}
        for dropout in (0.0, 0.2) for seed in range(5)
    ]  # fmt: skip
    frame = load.runs(pd.DataFrame(rows))
    assert "seed training_seed; metrics test_accuracy, loss" in capsys.readouterr().err
    assert selection.main_metric(frame) == "test_accuracy"
