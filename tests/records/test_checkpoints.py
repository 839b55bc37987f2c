"""checkpoint.pt and the one before it."""

import logging
import threading

import numpy as np
import pytest
import torch

from qnerf import records
from tests.helpers.stores import claimed


def test_checkpoints_rotate(store_):
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
    assert content["step"] == 3
    assert torch.equal(content["weights"], torch.full((3,), 3.0))
    run.resume(3)
    run.finish()
    assert [path.name for path in run.dir.glob("checkpoint*")] == ["checkpoint.pt"]


def test_a_checkpoint_that_could_not_be_read_back_is_refused(store_):
    run = claimed(store_)
    run.save_checkpoint({"value": 0.0})  # each is read back, not the first alone
    cases = {
        "numpy": np.ones(2),
        "scalar": np.float64(1.0),
        "Linear": torch.nn.Linear(1, 1),
        "<lambda>": lambda: 1,
        "lock": threading.Lock(),
    }
    for name, value in cases.items():
        with pytest.raises(
            ValueError, match=f"expected tensors and plain values only, got .*{name}.*state_dict"
        ) as caught:
            run.save_checkpoint({"value": value})
        assert "\n" not in str(caught.value)
    assert run.load_checkpoint() == {"value": 0.0}
    run.finish()


@pytest.mark.parametrize("damage", ["truncated", "flipped", "empty", "text", "not a dict"])
def test_a_damaged_checkpoint_falls_back(store_, damage, caplog):
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
    assert content["step"] == 1
    assert len(caplog.messages) == 1
    assert "checkpoint.pt: damaged" in caplog.messages[0]
    assert "going on from the checkpoint before" in caplog.messages[0]
    assert "\n" not in caplog.messages[0]
    assert len(list(run.dir.glob("damaged-*-checkpoint.pt"))) == 1
    run.save_checkpoint({"step": 3})
    assert torch.load(run.dir / "checkpoint.prev.pt", weights_only=True)["step"] == 1
    run.finish()


def test_two_damaged_checkpoints_start_over(store_, caplog):
    run = claimed(store_)
    for name in ("checkpoint.pt", "checkpoint.prev.pt"):
        (run.dir / name).write_bytes(b"x")
    with caplog.at_level(logging.WARNING):
        assert run.load_checkpoint() is None
    assert "starting over" in caplog.messages[1]
    run.finish()
