import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from qnerf.export import content, to_csv
from qnerf.records import annotations, read_metrics, read_status


@pytest.fixture
def run(store: Path) -> Path:
    (folder,) = store.glob("*-aaaaaaaaaa")
    annotations.change_tags(folder, ["good", "base"])
    annotations.write_note(folder, "=HYPERLINK(1)\nsecond [link](http://x)")
    return folder


def created(run: Path) -> float:
    return float(read_status(run)["created"])


def test_csv_holds_every_value(run, qnerf, tmp_path):
    folder = tmp_path / "out" / run.name
    for _ in range(2):  # the second time replaces the files and leaves others
        done = qnerf("export", "aaaa", "--to", "csv", "--out", tmp_path / "out")
        assert done.code == 0, done.err
        (folder / "mine.txt").write_text("x")
    assert sorted(path.name for path in folder.iterdir()) == ["eval.csv", "metrics.csv", "mine.txt", "summary.csv"]
    metrics = pd.read_csv(folder / "metrics.csv")
    assert metrics["step"].tolist() == [10, 20, 30, 40]
    assert metrics["train/loss"].tolist() == [1 / 10, 1 / 20, 1 / 30, 1 / 40]
    np.testing.assert_allclose(metrics["wall_time"], created(run) + metrics["time_s"])
    assert pd.read_csv(folder / "eval.csv")["psnr"].tolist() == [21.5, 22.5]
    summary = pd.read_csv(folder / "summary.csv").iloc[0]
    assert summary[["state", "tags", "psnr", "train.lr"]].tolist() == ["finished", "base,good", 21.5, 0.01]
    assert summary["note"].startswith("=HYPERLINK(1)")


def test_csv_tells_values_that_are_no_number_from_absent_ones():
    rows = pd.DataFrame(
        {"step": [1, 1, 2], "time_s": [0.1, 0.1, 0.2], "key": ["a", "b", "a"], "value": [1.0, np.nan, np.inf]}
    )
    wide = to_csv.wide(rows, 100.0)
    assert wide["a"].tolist() == ["1.0", "inf"]
    assert wide["b"].tolist()[0] == "nan"
    assert pd.isna(wide["b"].tolist()[1])
    assert wide["wall_time"].tolist() == [100.1, 100.2]


def test_tensorboard_reads_back_what_was_logged(run, qnerf, tmp_path):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = tmp_path / "out" / run.name
    folder.mkdir(parents=True)
    other = folder / "events.out.tfevents.1.other"
    other.write_bytes(b"")
    for _ in range(2):  # the second time doubles nothing
        done = qnerf("export", "aaaa", "--to", "tensorboard", "--out", tmp_path / "out")
        assert done.code == 0, done.err
    assert len(list(folder.iterdir())) == 2
    other.unlink()
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "tensors": 0, "images": 0})
    events.Reload()
    logged = read_metrics(run)
    assert set(events.Tags()["scalars"]) >= {*logged["key"], "final/psnr"}
    for key, rows in logged.groupby("key"):
        scalars = events.Scalars(str(key))
        assert [event.step for event in scalars] == rows["step"].tolist()
        np.testing.assert_allclose([event.value for event in scalars], rows["value"], rtol=1e-6)
        np.testing.assert_allclose([event.wall_time for event in scalars], created(run) + rows["time_s"])
    (image,) = events.Images("images/view0")
    assert (image.width, image.height) == (3, 2)
    (note,) = events.Tensors("note/text_summary")
    assert note.tensor_proto.string_val == [b"    =HYPERLINK(1)\n    second [link](http://x)"]
    assert {"_hparams_/session_start_info"} <= set(events.summary_metadata)


@pytest.fixture
def tracking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A client of a fresh SQLite tracking store."""
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed")
    pytest.importorskip("sqlalchemy", reason="mlflow's SQLite store needs sqlalchemy")
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.chdir(tmp_path)
    return mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")


@pytest.mark.filterwarnings("default")  # mlflow's own
def test_mlflow_has_every_value_once_and_goes_on_where_a_copy_ended(running, qnerf, tracking, monkeypatch):
    from qnerf.export import to_mlflow

    monkeypatch.setattr(to_mlflow, "METRICS", 3)
    monkeypatch.setattr(to_mlflow, "PARAMS", 2)

    def export():
        done = qnerf("export", "ffff", "--to", "mlflow", "--uri", tracking.tracking_uri)
        assert done.code == 0, done.err
        (copied,) = tracking.search_runs([tracking.get_experiment_by_name("qnerf").experiment_id])
        return copied, tracking.get_metric_history(copied.info.run_id, "train/loss")

    copied, history = export()
    assert copied.info.status == "RUNNING"
    assert [metric.step for metric in history] == [10, 20]
    running.log(30, 3.0, {"train/loss": float("nan"), "train/psnr": 16.0})
    running.save_image("view0", np.zeros((2, 3, 3), np.uint8))
    running.finish({"psnr": 20.0})
    annotations.change_tags(running.dir, ["late"])
    for _ in range(2):
        copied, history = export()
        assert copied.info.status == "FINISHED"
        assert [metric.step for metric in history] == [10, 20, 30]
    logged = read_metrics(running.dir).query("key == 'train/loss'")
    np.testing.assert_allclose(
        [metric.timestamp for metric in history], (created(running.dir) + logged["time_s"]) * 1000, atol=1
    )
    assert copied.data.params["train.lr"] == "0.01"
    assert len(copied.data.params) == len(content.read(running.dir).run.flat)
    assert copied.data.metrics["final/psnr"] == 20.0
    assert copied.data.tags["qnerf.tags"] == "late"
    artifacts = {item.path for item in tracking.list_artifacts(copied.info.run_id)}
    assert {"config.yaml", "images", "summary.parquet"} <= artifacts


@pytest.mark.filterwarnings("default")
def test_mlflow_that_cannot_be_reached_is_one_line(run, qnerf, tracking, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    done = qnerf("export", "aaaa", "--to", "mlflow", "--uri", "http://127.0.0.1:9")
    assert done.code == 2
    assert done.err.startswith("error: MLflow: ")
    assert done.err.count("\n") == 1


@pytest.mark.parametrize("target", ["mlflow", "tensorboard"])
def test_a_missing_extra_is_named(run, qnerf, monkeypatch, target):
    for name in [name for name in sys.modules if target in name.split(".")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, target, None)
    monkeypatch.delitem(sys.modules, f"qnerf.export.to_{target}", raising=False)
    done = qnerf("export", "aaaa", "--to", target)
    assert (done.code, done.err) == (2, f'error: {target} is not installed here: pip install "qnerf[{target}]"\n')


def test_nothing_is_exported_into_a_run_s_folder(store, run, qnerf):
    before = sorted(store.rglob("*"))
    for out in (store, run / "images"):
        done = qnerf("export", "aaaa", "--to", "csv", "--out", out)
        assert (done.code, done.err.count("\n")) == (2, 1)
        assert "is in a run's folder" in done.err
    assert sorted(store.rglob("*")) == before


def test_a_damaged_run_does_not_stop_the_export_of_others(store, qnerf, tmp_path):
    done = qnerf("export", "eeee", "aaaa", "--to", "csv", "--out", tmp_path / "out")
    assert done.code == 2
    assert "summary.parquet: damaged" in done.err
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["poster-qcolor-s0-aaaaaaaaaa"]
