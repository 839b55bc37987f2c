import json
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from qnerf.export import content, to_csv
from qnerf.records import annotations, read_metrics, read_status
from qnerf.records.spreadsheets import without_formula


@pytest.fixture
def run(store: Path) -> Path:
    (folder,) = store.glob("*-aaaaaaaaaa")
    annotations.change_tags(folder, ["good", "base"])
    annotations.write_note(folder, "=HYPERLINK(1)\nsecond [link](http://x)")
    return folder


def created(run: Path) -> float:
    return float(read_status(run)["created"])


# CSV


def test_csv_holds_every_value(run, qnerf, tmp_path):
    done = qnerf("export", "aaaa", "--to", "csv", "--out", tmp_path / "out")
    assert done.code == 0
    folder = tmp_path / "out" / run.name
    metrics = pd.read_csv(folder / "metrics.csv")
    assert metrics["step"].tolist() == [10, 20, 30, 40]
    assert metrics["train/loss"].tolist() == [1 / 10, 1 / 20, 1 / 30, 1 / 40]
    np.testing.assert_allclose(metrics["wall_time"], created(run) + metrics["time_s"])
    assert pd.read_csv(folder / "eval.csv")["psnr"].tolist() == [21.5, 22.5]
    summary = pd.read_csv(folder / "summary.csv").iloc[0]
    assert (summary["state"], summary["tags"], summary["psnr"], summary["train.lr"]) == (
        "finished",
        "base,good",
        21.5,
        0.01,
    )
    assert summary["note"].startswith("'=HYPERLINK(1)")


def test_csv_tells_values_that_are_no_number_from_absent_ones():
    rows = pd.DataFrame(
        {"step": [1, 1, 2], "time_s": [0.1, 0.1, 0.2], "key": ["a", "b", "a"], "value": [1.0, np.nan, np.inf]}
    )
    wide = to_csv.wide(rows, 100.0)
    assert wide["a"].tolist() == ["1.0", "inf"]
    assert wide["b"].tolist()[0] == "nan"
    assert pd.isna(wide["b"].tolist()[1])
    assert wide["wall_time"].tolist() == [100.1, 100.2]


@pytest.mark.parametrize(
    ("value", "cell"),
    [("=1+1", "'=1+1"), ("@x", "'@x"), ("-x", "'-x"), ("-1e3", "-1e3"), ("+5", "+5"), ("text", "text"), (-3, -3)],
)
def test_csv_has_no_formulas(value, cell):
    assert without_formula(value) == cell


def test_csv_again_replaces_and_leaves_other_files(run, qnerf, tmp_path):
    folder = tmp_path / "out" / run.name
    for _ in range(2):
        assert qnerf("export", "aaaa", "--to", "csv", "--out", tmp_path / "out").code == 0
        (folder / "mine.txt").write_text("x")
    assert sorted(path.name for path in folder.iterdir()) == ["eval.csv", "metrics.csv", "mine.txt", "summary.csv"]
    assert len(pd.read_csv(folder / "metrics.csv")) == 4


# TensorBoard


def test_tensorboard_reads_back_what_was_logged(run, qnerf, tmp_path):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for _ in range(2):  # the second time doubles nothing
        assert qnerf("export", "aaaa", "--to", "tensorboard", "--out", tmp_path / "out").code == 0
    folder = tmp_path / "out" / run.name
    assert len(list(folder.iterdir())) == 1
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "tensors": 0, "images": 0})
    events.Reload()
    logged = read_metrics(run)
    assert set(events.Tags()["scalars"]) == set(logged["key"])
    for key, rows in logged.groupby("key"):
        scalars = events.Scalars(str(key))
        assert [event.step for event in scalars] == rows["step"].tolist()
        np.testing.assert_allclose([event.value for event in scalars], rows["value"], rtol=1e-6)
        np.testing.assert_allclose([event.wall_time for event in scalars], created(run) + rows["time_s"])
    (image,) = events.Images("images/view0")
    assert (image.width, image.height, image.encoded_image_string) == (
        3,
        2,
        (run / "images" / "view0.png").read_bytes(),
    )
    (note,) = events.Tensors("note")
    assert note.tensor_proto.string_val == [b"    =HYPERLINK(1)\n    second [link](http://x)"]
    assert {"state", "tags", "_hparams_/session_start_info"} <= set(events.Tags()["tensors"])


@pytest.mark.parametrize("number", [10**400, -(10**400), 2**20_000], ids=["large", "small", "no text"])
def test_a_number_beyond_all_floats_is_exported_as_text(number):
    to_tensorboard = pytest.importorskip("qnerf.export.to_tensorboard", reason="tensorboard is not installed")
    assert to_tensorboard._hyperparameter(number) == f"an integer of {number.bit_length()} bits"
    assert to_tensorboard._hyperparameter(3) == 3


def test_tensorboard_leaves_other_files_alone(run, qnerf, tmp_path):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    folder = tmp_path / "out" / run.name
    folder.mkdir(parents=True)
    (folder / "events.out.tfevents.1.other").write_bytes(b"")
    assert qnerf("export", "aaaa", "--to", "tensorboard", "--out", tmp_path / "out").code == 0
    assert (folder / "events.out.tfevents.1.other").exists()


# MLflow


@pytest.fixture
def tracking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A client of a fresh SQLite tracking store."""
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed")
    pytest.importorskip("sqlalchemy", reason="mlflow's SQLite store needs sqlalchemy")
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.chdir(tmp_path)
    return mlflow.MlflowClient(f"sqlite:///{tmp_path}/mlflow.db")


def only_run(tracking):
    (run,) = tracking.search_runs([tracking.get_experiment_by_name("qnerf").experiment_id])
    return run


def steps(tracking, key: str) -> list[int]:
    return [metric.step for metric in tracking.get_metric_history(only_run(tracking).info.run_id, key)]


@pytest.mark.filterwarnings("default")  # mlflow's own
def test_mlflow_has_every_value_once(run, qnerf, tracking):
    for _ in range(2):
        done = qnerf("export", "aaaa", "--to", "mlflow", "--uri", tracking.tracking_uri)
        assert done.code == 0, done.err
    copied = only_run(tracking)
    logged = read_metrics(run).query("key == 'train/loss'")
    history = tracking.get_metric_history(copied.info.run_id, "train/loss")
    assert [(m.step, m.value) for m in history] == list(zip(logged["step"], logged["value"], strict=True))
    np.testing.assert_allclose([m.timestamp for m in history], (created(run) + logged["time_s"]) * 1000, atol=1)
    assert copied.info.status == "FINISHED"
    assert copied.data.params["train.lr"] == "0.01"
    assert copied.data.metrics["final/psnr"] == 21.5
    assert copied.data.tags["qnerf.tags"] == "base,good"
    assert copied.data.tags["mlflow.note.content"].startswith("=HYPERLINK")
    artifacts = {item.path for item in tracking.list_artifacts(copied.info.run_id)}
    assert {"config.yaml", "images", "eval.parquet"} <= artifacts
    assert [item.path for item in tracking.list_artifacts(copied.info.run_id, "images")] == ["images/view0.png"]


@pytest.mark.filterwarnings("default")
def test_mlflow_goes_on_where_a_copy_ended(running, qnerf, tracking):
    def export() -> None:
        done = qnerf("export", "ffff", "--to", "mlflow", "--uri", tracking.tracking_uri)
        assert done.code == 0, done.err

    export()
    assert only_run(tracking).info.status == "RUNNING"
    assert steps(tracking, "train/loss") == [10, 20]
    running.log(30, 3.0, {"train/loss": float("nan"), "train/psnr": 16.0})
    running.finish({"psnr": 20.0})
    tracking.delete_tag(only_run(tracking).info.run_id, "qnerf.copied")  # as if killed before the end
    export()
    assert only_run(tracking).info.status == "FINISHED"
    assert steps(tracking, "train/loss") == [10, 20, 30]
    annotations.change_tags(running.dir, ["late"])
    export()
    assert only_run(tracking).data.tags["qnerf.tags"] == "late"
    assert steps(tracking, "train/loss") == [10, 20, 30]


@pytest.mark.filterwarnings("default")
def test_mlflow_takes_more_than_one_batch(make, qnerf, tracking, monkeypatch):
    from qnerf.export import to_mlflow

    monkeypatch.setattr(to_mlflow, "METRICS", 3)
    monkeypatch.setattr(to_mlflow, "PARAMS", 2)
    run = make("a")
    assert qnerf("export", run, "--to", "mlflow", "--uri", tracking.tracking_uri).code == 0
    assert steps(tracking, "train/loss") == steps(tracking, "train/psnr") == [10, 20, 30, 40]
    assert len(only_run(tracking).data.params) == len(content.read(run).config)


@pytest.mark.filterwarnings("default")
def test_mlflow_that_cannot_be_reached_is_one_line(run, qnerf, tracking, monkeypatch):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    done = qnerf("export", "aaaa", "--to", "mlflow", "--uri", "http://127.0.0.1:9")
    assert done.code == 2
    assert done.err.startswith("error: MLflow: ")
    assert done.err.count("\n") == 1


# All targets


@pytest.mark.parametrize("target", ["mlflow", "tensorboard"])
def test_a_missing_extra_is_named(run, qnerf, monkeypatch, target):
    for name in [name for name in sys.modules if name.partition(".")[0] == target]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, target, None)
    monkeypatch.delitem(sys.modules, f"qnerf.export.to_{target}", raising=False)
    done = qnerf("export", "aaaa", "--to", target)
    assert (done.code, done.err) == (2, f'error: {target} is not installed here: pip install "qnerf[{target}]"\n')


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "mlflow", "--out", "x"], "mlflow takes --uri"),
        (["--to", "csv", "--uri", "x"], "csv takes --out"),
        (["--to", "wandb"], "invalid choice: 'wandb'"),
        ([], "the following arguments are required: --to"),
    ],
)
def test_a_mistake_is_one_line(run, qnerf, arguments, message):
    done = qnerf("export", "aaaa", *arguments)
    assert done.code == 2
    assert message in done.err


def test_nothing_is_exported_into_the_store_or_of_a_damaged_run(store, qnerf, tmp_path):
    assert "is in a run's folder" in qnerf("export", "aaaa", "--to", "csv", "--out", store).err
    assert "summary.parquet: damaged" in qnerf("export", "eeee", "--to", "csv", "--out", tmp_path / "out").err
    assert not (tmp_path / "out").exists()


def test_links_are_not_exported(run, tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("x")
    (run / "images" / "view1.png").symlink_to(secret)
    (run / "environment-2.json").symlink_to(secret)
    exported = content.read(run)
    assert [path.name for path in exported.images] == ["view0.png"]
    assert "environment-2.json" not in [path.name for path in exported.files]


def test_times_come_from_the_run(run):
    status = json.loads((run / "status.json").read_text())
    (run / "status.json").write_text(json.dumps(status | {"created": "yesterday"}))
    with pytest.raises(ValueError, match="created: expected a Unix time"):
        content.read(run)
    (run / "status.json").write_text(json.dumps(status | {"created": None}))
    assert content.read(run).created == (run / "config.yaml").stat().st_mtime


@pytest.mark.parametrize("target", ["csv", "tensorboard"])
def test_one_odd_run_does_not_stop_the_others(make, qnerf, tmp_path, target):
    if target == "tensorboard":
        pytest.importorskip("tensorboard")
    half, odd, plain = make("a"), make("b"), make("c")
    (half / "annotations.json").write_text(json.dumps({"tags": ["\ud800"], "note": "half \ud800"}))
    odd = odd.rename(odd.parent / "my run")
    done = qnerf("export", half, odd, plain, "--to", target, "--out", tmp_path / "out")
    assert done.code == 2
    assert done.err.splitlines() == ["error: expected a run's id of letters, digits, '.', '_' and '-', got 'my run'"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a", "c"]


@pytest.mark.parametrize("target", ["csv", "tensorboard"])
def test_nothing_is_exported_through_a_linked_folder_or_into_a_run(make, qnerf, tmp_path, target):
    if target == "tensorboard":
        pytest.importorskip("tensorboard")
    run, outside, out = make("a"), tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    out.mkdir()
    (out / "a").symlink_to(outside)
    assert "is a link" in qnerf("export", run, "--to", target, "--out", out).err
    assert not list(outside.iterdir())
    before = sorted(run.rglob("*"))
    assert "is in a run's folder" in qnerf("export", run, "--to", target, "--out", run / "images").err
    assert sorted(run.rglob("*")) == before
