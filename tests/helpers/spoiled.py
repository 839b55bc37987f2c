"""Runs that the tests for hostile folders damage."""

from pathlib import Path

from qnerf.records import Run, RunStore

CONFIG = {"seed": 0, "train": {"steps": 10}, "scene": {"name": "poster", "path": None}}


def store(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "runs", every=60, watch=0.1)


def started(tmp_path: Path, name: str = "a") -> Run:
    claim = store(tmp_path).claim(name, CONFIG)
    assert claim.run is not None, claim.message
    return claim.run


def interrupted(tmp_path: Path, name: str = "a") -> Path:
    """An interrupted run with ten rows, a checkpoint and the one before."""
    run = started(tmp_path, name)
    for step in range(10):
        run.log(step, 0.0, {"loss": 1 / (step + 1)})
        if step >= 8:
            run.save_checkpoint({"step": step})
    run.interrupt()
    return run.dir
