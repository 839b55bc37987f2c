"""Checkpoints of another person: nothing in them is executed, and the one before is used instead."""

import io
import logging
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.helpers.spoiled import interrupted, store


class Command:
    """Unpickling it runs a shell command."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def saved(content: object, **options: bool) -> bytes:
    data = io.BytesIO()
    torch.save(content, data, **options)
    return data.getvalue()


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path, command: path.write_bytes(saved({"step": 3, "x": Command(command)})),
        lambda path, command: path.write_bytes(saved(Command(command), _use_new_zipfile_serialization=False)),
        lambda path, command: path.write_bytes(pickle.dumps(Command(command))),
        lambda path, command: path.write_bytes(saved({"step": 3, "x": torch.zeros(2**18)})),  # larger than the run's
        lambda path, command: pipe(path),
    ],
    ids=["archive", "legacy", "pickle", "large", "pipe"],
)
def test_a_hostile_checkpoint_is_set_aside(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path, str], None]
) -> None:
    run = interrupted(tmp_path)
    spoil(run / "checkpoint.pt", f"touch {tmp_path / 'owned'}")
    claim = store(tmp_path).claim("a", {})
    assert claim.run is not None
    with caplog.at_level(logging.WARNING):
        assert claim.run.load_checkpoint(max_bytes=2**20) == {"step": 8}
    assert not (tmp_path / "owned").exists()
    (message,) = caplog.messages
    assert "damaged" in message
    assert "going on from the checkpoint before" in message
    assert "\n" not in message
    claim.run.save_checkpoint({"step": 9})
    claim.run.finish()
