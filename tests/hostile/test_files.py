"""Files of a run that are damaged or come from another person: one line each, nothing in them is executed."""

import io
import json
import os
import pickle

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from qnerf import records
from qnerf.records import RunStore, StoreError
from tests.helpers.stores import CONFIG, claimed


def store(tmp_path):
    return RunStore(tmp_path / "runs", every=60)


@pytest.fixture
def run(tmp_path):
    """An interrupted run with ten rows, a checkpoint and the one before."""
    run = claimed(store(tmp_path))
    for step in range(10):
        run.log(step, 0.0, {"loss": 1 / (step + 1)})
        if step >= 8:
            run.save_checkpoint({"step": step})
    run.interrupt()
    return run.dir


def goes_on(run):
    """The same command continues the run."""
    assert records.state(run) == "interrupted"
    claim = RunStore(run.parent).claim(run.name, CONFIG)
    assert claim.outcome == "resumed", claim.message
    claim.run.interrupt()


def refused(reader, run, match):
    with pytest.raises(StoreError, match=match) as error:
        reader(run)
    assert "\n" not in str(error.value)


def test_damaged_status_reads_as_interrupted(run):
    odd = ["", "[]", "{", "null", '"x"', '{"state": {"state": "running"}}', "\x00",
           '{"state": "finished?"}', '{"state": "running"}', '{"state": 1}']  # fmt: skip
    for text in odd:
        (run / "status.json").write_text(text)
        goes_on(run)


def spoil_records(run, **values):
    """Sets keys in status.json and in the owner's file, which are old."""
    for path in [run / "status.json", *run.glob("owner/*.json")]:
        path.write_text(json.dumps(json.loads(path.read_text()) | values))
        os.utime(path, (0, 0))


def test_pid_that_is_not_the_writer_s_does_not_hold_a_run(run):
    """Another user's process, not a number."""
    for pid in (1, 2**70, "../1", None, [1]):
        spoil_records(run, state="running", pid=pid, heartbeat=0, since=0, released=False)
        goes_on(run)


CONFIGS = (
    "a: !!python/object/apply:os.system ['touch OWNED']\n",
    "a: !!python/object/new:subprocess.Popen [['touch', 'OWNED']]\n",
    "a: !!python/name:os.system\n",
    "a: !Path /etc/passwd\n",
    "a: " + "9" * 5_000 + "\n",
    "[1, 2]\n",
    "hello\n",
    "",
    "\x00\x01",
    "a: \udcff\n",
    "a: !!binary aGk=\n",
)


def test_hostile_yaml_is_refused(run, tmp_path):
    for text in CONFIGS:
        data = text.replace("OWNED", str(tmp_path / "owned")).encode(errors="surrogateescape")
        (run / "config.yaml").write_bytes(data)
        refused(records.read_config, run, r"config\.yaml: ")
    assert not (tmp_path / "owned").exists()
    with pytest.raises(StoreError, match=r"config\.yaml: .*; delete this file, and the run goes on without it"):
        store(tmp_path).claim("a", CONFIG)
    (run / "config.yaml").unlink()
    goes_on(run)
    assert records.read_config(run) == CONFIG  # with the command's own


def test_a_date_in_yaml_stays_text(run):
    """As Hydra takes it."""
    (run / "config.yaml").write_text("a: 2001-01-01\nb: 2001-99-99\n")
    assert records.read_config(run) == {"a": "2001-01-01", "b": "2001-99-99"}


def test_a_file_that_is_no_table_is_damaged(run):
    for data in (b"", b"PAR1", b"PAR1" + bytes(100) + b"PAR1", b"hello", bytes(2**16)):
        (run / "metrics" / "part-00000.parquet").write_bytes(data)
        (run / "summary.parquet").write_bytes(data)
        refused(records.read_metrics, run, r"part-00000\.parquet: damaged")
        refused(records.read_summary, run, r"summary\.parquet: damaged")


def test_other_columns_are_damaged(run):
    metrics = {"step": [1], "time_s": [0.0], "key": ["a"], "value": [1.0]}
    odd = ({"more": [1]}, {"step": ["x"]}, {"value": [[1.0]]}, {"key": [{"a": 1}]})
    for columns in ({"step": [1]}, *(metrics | other for other in odd)):
        pq.write_table(pa.table(columns), run / "metrics" / "part-00000.parquet")
        refused(records.read_metrics, run, r"part-00000\.parquet: damaged")
    pq.write_table(pa.table(metrics | {"key": pa.nulls(1, pa.string())}), run / "metrics" / "part-00000.parquet")
    refused(records.read_metrics, run, "rows without a step, time, key or value")
    for rows in (0, 2):
        pq.write_table(pa.table({"run_id": ["a"] * rows}), run / "summary.parquet")
        refused(records.read_summary, run, f"expected one row, got {rows}")


class Command:
    """Unpickling it runs a shell command."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def saved(content, **options):
    data = io.BytesIO()
    torch.save(content, data, **options)
    return data.getvalue()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path, command: path.write_bytes(saved({"step": 3, "x": Command(command)})),
        lambda path, command: path.write_bytes(saved(Command(command), _use_new_zipfile_serialization=False)),
        lambda path, command: path.write_bytes(pickle.dumps(Command(command))),
    ],
    ids=["archive", "legacy", "pickle"],
)
def test_hostile_checkpoint_is_not_executed(run, tmp_path, spoil):
    spoil(run / "checkpoint.pt", f"touch {tmp_path / 'owned'}")
    resumed = claimed(store(tmp_path))
    assert resumed.load_checkpoint() == {"step": 8}
    assert not (tmp_path / "owned").exists()
    resumed.finish()
