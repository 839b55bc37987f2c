import errno
import json
import logging
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from PIL import Image

from qnerf import records
from qnerf.records import Run, RunStore, StoreError, owner, read, store, writer

CONFIG = {
    "seed": 0,
    "train": {"lr": 1e-6, "steps": 10, "eval_views": None},
    "scene": {"name": "poster", "path": None, "label": "1e-2"},
    "odd": ["a", 1],
    "hydra": {"x": 1},
}


@pytest.fixture
def store_(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "runs", every=60, watch=0.3)


def claimed(store: RunStore, name: str = "a", **options: Any) -> Run:
    claim = store.claim(name, CONFIG, ["seed=0"], **options)
    assert claim.run is not None, claim.message
    return claim.run


def vanish(run: Run) -> None:
    """As a killed process leaves it: nothing more is written and the recorded owner is no living process."""
    run._stop()
    run._closed = True
    for path in [run.dir / "status.json", *run.dir.glob("owner/*.json")]:
        record = json.loads(path.read_text()) | {"started": "1"}
        path.write_text(json.dumps(record))


def test_a_new_run_is_complete_from_its_first_moment(store_: RunStore) -> None:
    claim = store_.claim(
        "fox-1", CONFIG, ["seed=0", "train.lr=1e-6"], columns={"field": "qcolor", "time.field_ms": None}
    )
    assert (claim.outcome, claim.dir.name) == ("new", "fox-1")
    assert claim.run is not None
    assert not claim.run.resumed
    assert (claim.dir / "overrides.txt").read_text() == "seed=0\ntrain.lr=1e-6\n"
    metrics = pd.read_parquet(claim.dir / "metrics")
    assert {k: str(v) for k, v in metrics.dtypes.items()} == {
        "step": "int64",
        "time_s": "float64",
        "key": "str",
        "value": "float64",
    }
    assert len(pd.read_parquet(claim.dir / "eval.parquet")) == 0
    row = pd.read_parquet(claim.dir / "summary.parquet").iloc[0]
    assert (row["run_id"], row["state"], row["field"]) == ("fox-1", "running", "qcolor")
    assert (row["seed"], row["train.lr"], row["odd"]) == (0, 1e-6, '["a", 1]')
    assert "hydra.x" not in row
    assert records.state(claim.dir) == "running"
    assert store_.runs() == [claim.dir]
    claim.run.finish()


def test_config_reads_back_the_same_with_every_reader(store_: RunStore) -> None:
    run = claimed(store_)
    text = (run.dir / "config.yaml").read_text()
    assert records.read_config(run.dir) == CONFIG == yaml.safe_load(text)
    assert OmegaConf.to_container(OmegaConf.create(text)) == CONFIG
    run.interrupt()


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.text(max_size=5), st.none() | st.booleans() | st.integers() | st.floats() | st.text()))
def test_any_text_and_number_survives_yaml(config: dict) -> None:
    # repr, because nan differs from itself
    assert repr(yaml.safe_load(store.to_yaml(config))) == repr(config)


def test_log_and_read(store_: RunStore) -> None:
    run = claimed(store_)
    for step in range(5):
        run.log(step, 0.5 * step, {"loss": 1 / (step + 1), "psnr": float("nan") if step == 2 else step})
    run.log(5, 2.5, {"loss": torch.tensor(0.25), "flag": True})
    assert len(records.read_metrics(run.dir)) == 0
    run.flush()
    run.flush()
    frame = records.read_metrics(run.dir)
    assert len(frame) == 12
    assert frame["step"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert frame.query("key == 'loss'")["value"].tolist() == [1, 1 / 2, 1 / 3, 1 / 4, 1 / 5, 0.25]
    assert np.isnan(frame["value"][5])
    assert frame["time_s"].tolist()[-1] == 2.5
    run.finish()


@pytest.mark.parametrize("value", ["3", None, [1.0], torch.zeros(2)])
def test_what_is_no_number_is_refused_whole(store_: RunStore, value: object) -> None:
    run = claimed(store_)
    with pytest.raises(ValueError, match="log: psnr expects a number, got"):
        run.log(0, 0.0, {"loss": 1.0, "psnr": value})  # type: ignore[dict-item]
    run.finish()
    assert len(records.read_metrics(run.dir)) == 0


def test_rows_reach_the_disk_by_themselves(tmp_path: Path) -> None:
    run = claimed(RunStore(tmp_path, every=0.02))
    run.log(3, 0.0, {"loss": 1.0})
    before = records.read_status(run.dir)["heartbeat"]
    end = time.monotonic() + 20
    while time.monotonic() < end and (
        len(records.read_metrics(run.dir)) == 0 or records.read_status(run.dir)["heartbeat"] == before
    ):
        time.sleep(0.01)
    assert len(records.read_metrics(run.dir)) == 1
    assert records.read_status(run.dir)["step"] == 3
    run.finish()


def test_parts_close_and_stay(store_: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "PART_ROWS", 10)
    run = claimed(store_)
    for step in range(13):
        run.log(step, 0.0, {"a": step, "b": -step})
    run.flush()
    parts = sorted((run.dir / "metrics").iterdir())
    assert [pq.read_metadata(part).num_rows for part in parts] == [10, 10, 6]
    closed = [part.stat().st_ino for part in parts[:2]]
    for step in range(13, 20):
        run.log(step, 0.0, {"a": step, "b": -step})
        run.flush()
    assert [part.stat().st_ino for part in parts[:2]] == closed
    frame = records.read_metrics(run.dir)
    assert frame["value"].tolist() == [sign * step for step in range(20) for sign in (1, -1)]
    run.finish()


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 7), st.integers(0, 30), st.integers(-1, 32), st.integers(0, 12))
def test_resume_drops_exactly_what_lies_beyond(
    tmp_path_factory: pytest.TempPathFactory, part_rows: int, steps: int, kept: int, more: int
) -> None:
    store = RunStore(tmp_path_factory.mktemp("runs"), every=60)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "PART_ROWS", part_rows)
        run = claimed(store)
        for step in range(steps):
            run.log(step, 0.0, {"a": step, "b": -step})
        run.interrupt()
        again = claimed(store)
        assert again.resumed
        again.resume(kept)
        expected = list(range(min(steps, kept + 1)))
        assert records.read_metrics(run.dir)["step"].tolist() == [step for step in expected for _ in "ab"]
        for step in range(len(expected), len(expected) + more):
            again.log(step, 0.0, {"b": -step, "a": step})
        again.finish()
    frame = records.read_metrics(run.dir)
    assert frame.query("key == 'a'")["value"].tolist() == list(range(len(expected) + more))
    assert not frame.duplicated(["step", "key"]).any()


def test_evaluation_keeps_its_types(store_: RunStore) -> None:
    run = claimed(store_)
    run.log(40, 1.0, {"loss": 1.0})
    rows = [{"image": "a.png", "psnr": 20, "lpips": None, "lpips_reason": "no weights", "note": None, "view": 3}]
    run.write_eval([*rows, {"image": "b.png", "psnr": 21.5, "note": "dark"}])
    frame = pd.read_parquet(run.dir / "eval.parquet")
    assert frame["psnr"].tolist() == [20.0, 21.5]
    assert frame["step"].tolist() == [40, 40]
    assert {str(frame[name].dtype) for name in ("ssim", "lpips", "depth_error", "view")} == {"float64"}
    assert {str(frame[name].dtype) for name in ("image", "lpips_reason", "note")} == {"str"}
    with pytest.raises(ValueError, match="psnr: expected a number, got 'high'"):
        run.write_eval([{"image": "a.png", "psnr": "high"}])
    run.finish()
    assert len(pd.read_parquet(run.dir / "eval.parquet")) == 2


def test_summary_collects_and_keeps_its_types(store_: RunStore) -> None:
    run = claimed(store_, columns={"field": "qcolor"})
    run.write_summary({"psnr": 20, "params.color": 211})
    run.interrupt()
    assert records.read_summary(run.dir)["state"] == "interrupted"
    run = claimed(store_)
    assert records.read_summary(run.dir)["state"] == "running"
    run.finish({"steps": 10, "time.field_ms": None, "step_ms": 24})
    schema = {name: str(kind) for name, kind in zip(*_schema(run.dir / "summary.parquet"), strict=True)}
    row = records.read_summary(run.dir)
    assert (row["field"], row["psnr"], row["params.color"], row["steps"]) == ("qcolor", 20.0, 211, 10)
    assert row["state"] == "finished"
    assert {schema[name] for name in ("psnr", "lpips", "time.field_ms", "step_ms", "train.lr")} == {"double"}
    assert {schema[name] for name in ("params.color", "params.encoder", "steps", "seed")} == {"int64"}
    assert {schema[name] for name in ("lpips_reason", "error", "field")} == {"string"}
    assert schema["scene.path"] == schema["train.eval_views"] == "null"
    assert list(row)[: len(set(row) - {"scene.path"})].count("psnr") == 1


def _schema(path: Path) -> tuple[list[str], list[Any]]:
    schema = pq.read_schema(path)
    return schema.names, schema.types


def test_environment_of_every_start_is_kept(store_: RunStore) -> None:
    run = claimed(store_)
    for environment, diff in (({"a": 1}, "x"), ({"a": 1}, "x"), ({"a": 2}, ""), ({"a": 2}, "")):
        run.write_environment(environment, diff)
    assert json.loads((run.dir / "environment.json").read_text()) == {"a": 1}
    assert (run.dir / "dirty.diff").read_text() == "x"
    assert json.loads((run.dir / "environment-2.json").read_text()) == {"a": 2}
    assert len(list(run.dir.glob("environment*"))) == 2
    assert len(list(run.dir.glob("dirty*"))) == 1
    run.finish()


def test_images_and_texts(store_: RunStore) -> None:
    run = claimed(store_)
    picture = np.random.default_rng(0).integers(0, 255, (4, 5, 3), dtype=np.uint8)
    run.save_image("view_000", picture)
    assert np.array_equal(np.asarray(Image.open(run.dir / "images" / "view_000.png")), picture)
    for name in ("../x", "a/b", "", ".hidden"):
        with pytest.raises(ValueError, match="plain file name"):
            run.save_image(name, picture)
    with pytest.raises(ValueError, match=r"uint8, got \(4, 5, 3\) float64"):
        run.save_image("x", picture / 255)
    run.text_log("one\ntwo")
    assert (run.dir / "log.txt").read_text().endswith(" one two\n")
    run.finish()


def test_checkpoints_rotate(store_: RunStore) -> None:
    run = claimed(store_)
    assert run.load_checkpoint() is None
    for step in (1, 2, 3):
        run.log(step, 0.0, {"loss": 0.0})
        run.save_checkpoint({"step": step, "weights": torch.full((3,), float(step))})
        assert records.read_metrics(run.dir)["step"].max() == step
    assert torch.load(run.dir / "checkpoint.prev.pt", weights_only=True)["step"] == 2
    run.interrupt()
    run = claimed(store_)
    content = run.load_checkpoint()
    assert content is not None
    assert content["step"] == 3
    assert torch.equal(content["weights"], torch.full((3,), 3.0))
    run.resume(3)
    run.finish()
    assert [path.name for path in run.dir.glob("checkpoint*")] == ["checkpoint.pt"]


def test_a_checkpoint_that_could_not_be_read_back_is_refused(store_: RunStore) -> None:
    run = claimed(store_)
    with pytest.raises(ValueError, match="checkpoint: expected tensors and plain values only"):
        run.save_checkpoint({"random": np.random.default_rng(0).bit_generator})
    assert not list(run.dir.glob("*checkpoint*"))
    run.finish()


def test_killed_between_the_two_renames_of_a_checkpoint(store_: RunStore) -> None:
    run = claimed(store_)
    run.save_checkpoint({"step": 1})
    run.save_checkpoint({"step": 2})
    (run.dir / "checkpoint.prev.pt").unlink()
    os.link(run.dir / "checkpoint.pt", run.dir / "checkpoint.prev.pt")
    run.save_checkpoint({"step": 3})
    assert torch.load(run.dir / "checkpoint.pt", weights_only=True)["step"] == 3
    assert torch.load(run.dir / "checkpoint.prev.pt", weights_only=True)["step"] == 2
    assert not list(run.dir.glob(".*"))
    run.finish()


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text", "not a dict"])
def test_a_damaged_checkpoint_falls_back(store_: RunStore, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    run = claimed(store_)
    for step in (1, 2):
        run.save_checkpoint({"step": step, "weights": torch.arange(5000.0)})
    path = run.dir / "checkpoint.pt"
    data = bytearray(path.read_bytes())
    match damage:
        case "truncated":
            path.write_bytes(data[: len(data) // 2])
        case "flipped":
            data[len(data) // 2] ^= 1
            path.write_bytes(data)
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_text("hello")
        case "not a dict":
            torch.save([1, 2], path)
    with caplog.at_level(logging.WARNING):
        content = run.load_checkpoint()
    assert content is not None
    assert content["step"] == 1
    assert len(caplog.messages) == 1
    assert "checkpoint.pt: damaged" in caplog.messages[0]
    assert "going on from the checkpoint before" in caplog.messages[0]
    assert "\n" not in caplog.messages[0]
    assert len(list(run.dir.glob("damaged-*-checkpoint.pt"))) == 1
    run.save_checkpoint({"step": 3})
    assert torch.load(run.dir / "checkpoint.prev.pt", weights_only=True)["step"] == 1
    run.finish()


def test_two_damaged_checkpoints_start_over(store_: RunStore, caplog: pytest.LogCaptureFixture) -> None:
    run = claimed(store_)
    for name in ("checkpoint.pt", "checkpoint.prev.pt"):
        (run.dir / name).write_bytes(b"x")
    with caplog.at_level(logging.WARNING):
        assert run.load_checkpoint() is None
    assert "starting over" in caplog.messages[1]
    run.finish()


def test_code_in_a_checkpoint_is_not_run(store_: RunStore, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Hostile:
        def __reduce__(self) -> tuple:
            return os.system, (f"touch {tmp_path / 'owned'}",)

    run = claimed(store_)
    torch.save({"x": Hostile()}, run.dir / "checkpoint.pt")
    with caplog.at_level(logging.WARNING):
        assert run.load_checkpoint() is None
    assert not (tmp_path / "owned").exists()
    run.finish()


def test_code_in_a_configuration_is_not_run(store_: RunStore, tmp_path: Path) -> None:
    run = claimed(store_)
    run.finish()
    (run.dir / "config.yaml").write_text(f"a: !!python/object/apply:os.system ['touch {tmp_path / 'owned'}']\n")
    with pytest.raises(StoreError, match="not readable as YAML"):
        records.read_config(run.dir)
    assert not (tmp_path / "owned").exists()


def test_a_damaged_part_is_set_aside(
    store_: RunStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(writer, "PART_ROWS", 10)
    run = claimed(store_)
    for step in range(25):
        run.log(step, 0.0, {"a": step})
    run.interrupt()
    part = run.dir / "metrics" / "part-00001.parquet"
    data = part.read_bytes()
    part.write_bytes(data[:-20])
    run = claimed(store_)
    with caplog.at_level(logging.WARNING):
        run.resume(22)
    assert len(caplog.messages) == 1
    assert "part-00001.parquet: damaged" in caplog.messages[0]
    assert next(run.dir.glob("damaged-*.parquet")).read_bytes() == data[:-20]
    run.log(23, 0.0, {"a": 23})
    run.finish()
    assert records.read_metrics(run.dir)["step"].tolist() == [*range(10), *range(20, 24)]


def test_context_manager_ends_the_run(store_: RunStore) -> None:
    def broken() -> None:
        with claimed(store_, "a") as run:
            run.log(0, 0.0, {"loss": 1.0})
            raise ValueError("loss is\nNaN at step 7")

    def stopped() -> None:
        with claimed(store_, "b"):
            raise KeyboardInterrupt

    with pytest.raises(ValueError, match="NaN at step 7"):
        broken()
    status = records.read_status(store_.root / "a")
    assert (status["state"], status["error"]) == ("failed", "loss is NaN at step 7")
    assert len(records.read_metrics(store_.root / "a")) == 1
    assert records.read_summary(store_.root / "a")["error"] == "loss is NaN at step 7"
    with pytest.raises(KeyboardInterrupt):
        stopped()
    assert records.state(store_.root / "b") == "interrupted"
    with claimed(store_, "c"):
        pass
    assert records.state(store_.root / "c") == "interrupted"
    for name in "abc":
        again = store_.claim(name, CONFIG)
        assert again.outcome == "resumed"
        assert again.run is not None
        assert records.read_status(again.dir)["error"] is None
        again.run.finish()


def test_a_finished_run_is_skipped_and_done_over_by_force(store_: RunStore) -> None:
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    run.finish({"psnr": 20.0})
    claim = store_.claim("a", CONFIG)
    assert (claim.outcome, claim.run) == ("finished", None)
    assert "finished already; run.force=true does it over" in claim.message
    again = store_.claim("a", CONFIG, force=True)
    assert again.outcome == "new"
    assert again.run is not None
    assert len(records.read_metrics(again.dir)) == 0
    assert records.read_summary(again.dir)["psnr"] is None
    assert list((store_.root / ".tmp").iterdir()) == []
    assert store_.claim("a", CONFIG, force=True).outcome == "busy"
    again.run.finish()


def test_a_living_owner_is_respected(store_: RunStore) -> None:
    run = claimed(store_)
    claim = store_.claim("a", CONFIG)
    assert (claim.outcome, claim.run) == ("busy", None)
    assert claim.owner is not None
    assert claim.owner.pid == os.getpid()
    assert f"already being written by process {os.getpid()} on this machine" in claim.message
    run.finish()


def test_a_recycled_pid_is_not_the_owner(store_: RunStore) -> None:
    run = claimed(store_)
    assert records.state(run.dir) == "running"
    vanish(run)  # our own pid, which lives, with another start time
    assert records.state(run.dir) == "interrupted"
    again = store_.claim("a", CONFIG)
    assert again.outcome == "resumed"
    assert "was interrupted, going on from the start" in again.message
    assert again.run is not None
    again.run.finish()


def elsewhere(run: Run, age: float) -> None:
    """The run as a process on another machine left it `age` seconds ago."""
    run._stop()
    run._closed = True
    for path in [run.dir / "status.json", *run.dir.glob("owner/*.json")]:
        record = json.loads(path.read_text()) | {"host": "other", "boot": "other", "heartbeat": time.time() - age}
        path.write_text(json.dumps(record))


@pytest.mark.parametrize(("age", "alive"), [(1, True), (-20, True), (1000, False), (-1000, False)])
def test_a_run_elsewhere_lives_by_its_heartbeat(store_: RunStore, age: float, alive: bool) -> None:
    run = claimed(store_)
    elsewhere(run, age)
    assert records.state(run.dir) == ("running" if alive else "interrupted")
    claim = store_.claim("a", CONFIG)
    assert claim.outcome == ("busy" if alive else "resumed")
    if claim.run is not None:
        claim.run.finish()


def test_a_clock_that_is_off_does_not_lose_a_run_to_another_machine(tmp_path: Path) -> None:
    store = RunStore(tmp_path, every=60, watch=30)
    run = claimed(store)
    elsewhere(run, 1000)

    def beat() -> None:
        time.sleep(0.3)
        elsewhere(run, 990)

    thread = threading.Thread(target=beat)
    thread.start()
    claim = store.claim("a", CONFIG)
    thread.join()
    assert claim.outcome == "busy"
    assert "on other" in claim.message


def test_a_clock_set_back_changes_nothing_here(store_: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now - 1e6)
    run.status(step=1)
    assert records.state(run.dir) == "running"
    assert store_.claim("a", CONFIG).outcome == "busy"
    monkeypatch.undo()
    assert records.state(run.dir) == "running"
    run.finish()
    assert records.state(run.dir) == "finished"


def test_a_writer_that_was_succeeded_stops(store_: RunStore) -> None:
    first = claimed(store_)
    first.log(0, 0.0, {"loss": 1.0})
    mine = next(first.dir.glob("owner/*.json"))
    record = json.loads(mine.read_text())
    mine.write_text(json.dumps(record | {"started": "1"}))
    second = claimed(store_)
    for write in (first.flush, first.status, lambda: first.save_checkpoint({}), lambda: first.write_eval([])):
        with pytest.raises(StoreError, match="taken over by another process"):
            write()
    with pytest.raises(StoreError, match="taken over"):
        first.finish()
    assert records.state(second.dir) == "running"
    second.finish()


def test_a_late_contender_does_not_become_a_second_owner(store_: RunStore) -> None:
    """One that judged owner n stale, slept, and wants n + 1 when n + 2 owns the run already."""
    run = claimed(store_)
    run.interrupt()
    stale = owner.newest(run.dir)[1]
    held = [claimed(store_), None]
    held[0].interrupt()
    last = claimed(store_)
    late = owner.write(run.dir, 1)
    assert late is not None
    assert not owner._follows(run.dir, late, stale)
    last.flush()
    last.finish()


def test_a_missing_file_is_made_again(store_: RunStore) -> None:
    run = claimed(store_)
    run.interrupt()
    for name in ("config.yaml", "eval.parquet", "status.json"):
        (run.dir / name).unlink()
    (run.dir / "summary.parquet").write_bytes(b"")
    (run.dir / ".part-00000.parquet.0000.tmp").write_bytes(b"")
    run = claimed(store_)
    assert run.resumed
    assert records.read_config(run.dir) == CONFIG
    assert records.read_summary(run.dir)["run_id"] == "a"
    assert not list(run.dir.glob(".*"))
    run.finish()


def test_leftovers_of_killed_processes_go(store_: RunStore) -> None:
    claimed(store_).interrupt()
    old, new = store_.root / ".tmp" / "old-a-00000000", store_.root / ".tmp" / "new-a-00000000"
    old.mkdir()
    new.mkdir()
    os.utime(new, (0, 0))
    fresh = store_.root / ".tmp" / "new-a-11111111"
    fresh.mkdir()
    claimed(store_).finish()
    assert list((store_.root / ".tmp").iterdir()) == [fresh]


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".a", "a b", "a" * 300])
def test_run_ids_stay_in_the_store(store_: RunStore, name: str) -> None:
    with pytest.raises(ValueError, match="run_id: expected letters"):
        store_.claim(name, CONFIG)


def test_no_space(store_: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    run.save_checkpoint({"step": 0})
    content = {path: path.read_bytes() for path in run.dir.rglob("*") if path.is_file()}

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    run.log(1, 0.0, {"loss": 1.0})
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        for write in (run.flush, lambda: run.save_checkpoint({"step": 1}), lambda: run.write_summary({"psnr": 1})):
            with pytest.raises(StoreError, match=r"cannot write: No space left on device$"):
                write()
    assert {path: path.read_bytes() for path in run.dir.rglob("*") if path.is_file()} == content
    run.finish()
    assert len(records.read_metrics(run.dir)) == 2


def test_an_error_in_the_background_reaches_the_training_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = claimed(RunStore(tmp_path, every=0.01))

    def refused(source: Any, target: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def train() -> None:
        with run:
            end = time.monotonic() + 20
            step = 0
            while time.monotonic() < end:
                run.log(step, 0.0, {"loss": 1.0})
                step += 1
                time.sleep(0.001)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refused)
        with pytest.raises(StoreError, match=r"cannot write: Read-only file system$"):
            train()
    assert records.state(run.dir) == "interrupted"  # not even the failure could be written
    again = claimed(RunStore(tmp_path))
    assert again.resumed
    again.interrupt()


def test_the_store_is_removed_under_a_running_job(store_: RunStore) -> None:
    import shutil

    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    shutil.rmtree(store_.root)
    with pytest.raises(StoreError, match="folder was removed or moved while the run was writing"):
        run.flush()
    with pytest.raises(StoreError, match="folder was removed"):
        run.finish()
    assert not store_.root.exists()


def test_a_store_that_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "runs"):
        with pytest.raises(StoreError, match="cannot write"):
            RunStore(root).claim("a", CONFIG)
    (tmp_path / "a").write_text("")
    with pytest.raises(StoreError, match="cannot create the run's folder"):
        RunStore(tmp_path).claim("a", CONFIG)
    assert list((tmp_path / ".tmp").iterdir()) == []


@pytest.mark.parametrize("text", ["", "[]", "{", '{"state": "finished?"}', '{"state": "running"}', '{"state": 1}'])
def test_a_damaged_status_reads_as_interrupted(tmp_path: Path, text: str) -> None:
    (tmp_path / "status.json").write_text(text)
    assert read.state(tmp_path) == "interrupted"


def test_no_hard_links(store_: RunStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsupported(source: Any, target: Any) -> None:
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(os, "link", unsupported)
    run = claimed(store_)
    assert store_.claim("a", CONFIG).outcome == "busy"
    for step in (1, 2):
        run.save_checkpoint({"step": step})
    assert torch.load(run.dir / "checkpoint.prev.pt", weights_only=True)["step"] == 1
    run.interrupt()
    claimed(store_).finish()
    assert store_.claim("a", CONFIG).outcome == "finished"
