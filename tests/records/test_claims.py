"""Claims of a run: skipped, resumed, started again, refused."""

import errno
import os

import numpy as np
import pytest
import torch

from qnerf import records
from qnerf.records import store
from qnerf.records.files import replace
from tests.helpers.stores import CONFIG, claimed


def test_context_manager_ends_the_run(store_):
    def broken():
        with claimed(store_, "a") as run:
            run.log(0, 0.0, {"loss": 1.0})
            raise ValueError("loss is\nNaN at step 7")

    def stopped():
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


def test_a_finished_run_is_skipped_and_done_over_by_force(store_):
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    run.finish({"psnr": 20.0})
    claim = store_.claim("a", CONFIG)
    assert (claim.outcome, claim.run) == ("finished", None)
    assert "finished already; run.force=true does it over" in claim.message
    again = store_.claim("a", CONFIG, force=True)
    assert again.outcome == "new"
    assert len(records.read_metrics(again.dir)) == 0
    assert records.read_summary(again.dir)["psnr"] is None
    assert store_.claim("a", CONFIG, force=True).outcome == "busy"
    again.run.finish()


def test_a_run_done_over_loses_our_files_alone(store_):
    run = claimed(store_)
    run.log(0, 0.0, {"loss": 1.0})
    run.save_image("0", np.zeros((2, 2), np.uint8))
    run.write_eval([{"image": "0.png", "psnr": 1.0}])
    run.save_checkpoint({"step": 1})
    run.text_log("line")
    run.finish()
    ours = ["checkpoint.pt", "log.txt", "images/0.png", "units.parquet", "damaged-1-checkpoint.pt"]
    users = [
        "notes.md",
        "plots/a.png",
        "images/mine.png",
        "metrics/notes.txt",
        "checkpoint-best.pt",
        "marks.json",
    ]
    for name in (*users, *ours[-2:]):
        (run.dir / name).parent.mkdir(exist_ok=True)
        (run.dir / name).write_text("x")
    assert all((run.dir / name).exists() for name in ours)
    claimed(store_, force=True).interrupt()
    assert [name for name in ours if (run.dir / name).exists()] == []
    assert [name for name in users if not (run.dir / name).exists()] == []
    assert len(records.read_metrics(run.dir)) == 0
    assert "from the start" in store_.claim("a", CONFIG).message


def test_a_kill_while_a_run_is_done_over_leaves_no_old_result(store_, monkeypatch):
    run = claimed(store_)
    run.save_checkpoint({"step": 1})
    run.finish({"psnr": 20.0})

    def killed(path, *arguments, **options):
        if path.name == "config.yaml":
            raise KeyboardInterrupt
        replace(path, *arguments, **options)

    monkeypatch.setattr(store, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        store_.claim("a", CONFIG, force=True)
    assert records.read_summary(run.dir)["psnr"] is None
    assert not (run.dir / "checkpoint.pt").exists()


def test_a_missing_file_is_made_again(store_):
    run = claimed(store_)
    run.interrupt()
    for name in ("config.yaml", "eval.parquet", "status.json", "summary.parquet"):
        (run.dir / name).unlink()
    (run.dir / ".part-00000.parquet.0000.tmp").write_bytes(b"")
    run = claimed(store_)
    assert run.resumed
    assert records.read_config(run.dir) == CONFIG
    assert records.read_summary(run.dir)["run_id"] == "a"
    assert not list(run.dir.glob(".*"))
    run.finish()


def test_a_claim_without_hard_links(store_, monkeypatch):
    def unsupported(*_, **__):
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
