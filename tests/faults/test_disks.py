"""A real full disk and a real read-only disk. The tests need the right to mount a tmpfs."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from qnerf import records
from qnerf.records import RunStore, StoreError


def mount(*arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(["mount", *arguments], capture_output=True, text=True, timeout=20, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return subprocess.CompletedProcess(arguments, 1, "", str(error))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    done = mount("-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder))
    if done.returncode != 0:
        pytest.skip(f"cannot mount a small disk here: {done.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True, timeout=20)


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "log.txt"}


def test_full_disk(disk: Path) -> None:
    def train() -> None:
        claim = RunStore(disk / "runs", every=0.01).claim("a", {"seed": 0})
        assert claim.run is not None
        random = np.random.default_rng(0)
        with claim.run as run:
            for step in range(100_000):
                run.log(step, float(step), {f"k{i}": v for i, v in enumerate(random.standard_normal(50))})
                if step % 100 == 99:
                    run.save_checkpoint({"step": step})

    with pytest.raises(StoreError, match=r"cannot write: No space left on device$"):
        train()
    directory = disk / "runs" / "a"
    metrics = records.read_metrics(directory)
    steps = metrics["step"].unique()
    assert len(metrics) == 50 * len(steps)
    assert steps.tolist() == list(range(len(steps)))
    assert torch.load(directory / "checkpoint.pt", weights_only=True)["step"] <= steps[-1]
    assert not list(directory.rglob(".*.tmp"))
    assert records.state(directory) in ("failed", "interrupted")


def test_checkpoint_larger_than_the_disk(disk: Path) -> None:
    claim = RunStore(disk / "runs", every=60).claim("a", {"seed": 0})
    assert claim.run is not None
    with claim.run as run:
        run.save_checkpoint({"step": 1, "weights": torch.zeros(1000)})
        before = snapshot(run.dir)
        with pytest.raises(StoreError, match=r"checkpoint\.pt: cannot write: No space left on device$"):
            run.save_checkpoint({"step": 2, "weights": torch.zeros(1_000_000)})
        assert snapshot(run.dir) == before
        run.finish()


def test_read_only_disk(disk: Path) -> None:
    store = RunStore(disk / "runs", every=60)
    claim = store.claim("a", {"seed": 0})
    assert claim.run is not None
    done = store.claim("b", {"seed": 0})
    assert done.run is not None
    done.run.finish()
    claim.run.log(0, 0.0, {"loss": 1.0})
    remounted = mount("-o", "remount,ro", str(disk))
    assert remounted.returncode == 0, remounted.stderr
    with pytest.raises(StoreError, match=r"cannot write: Read-only file system$"):
        claim.run.flush()
    with pytest.raises(StoreError, match="Read-only file system"):
        store.claim("c", {"seed": 0})
    assert store.claim("b", {"seed": 0}).outcome == "finished"
    assert len(records.read_metrics(claim.dir)) == 0
    with pytest.raises(StoreError, match="Read-only file system"):
        claim.run.finish()
