"""A loop that knows nothing of radiance fields is a run like the others."""

from pathlib import Path

import numpy as np
import pytest
import torch
from qnerf.analysis import load
from qnerf.analysis.tables import ablation

import qnerf
from qnerf import records
from qnerf.cli import main
from qnerf.records import StoreError

LAST = 12


def descent(rate: float, store: Path, seed: int = 0, stop: int | None = None) -> dict[int, float]:
    """Minimises the square of a number, x, and saves every fifth step; returns x by step. stop: it is killed there."""
    x, seen = torch.tensor(1.0 + seed), dict[int, float]()
    with qnerf.track(
        {"scene": "square", "seed": seed, "rate": rate, "steps": LAST}, name="descent", store=store
    ) as run:
        x = x if run.state is None else run.state["x"]
        for step in run.steps(LAST):
            x = x - 2 * rate * x
            seen[step] = x.item()
            run.log(step, {"train/loss": float(x**2)}, x=x.item())
            if step % 5 == 0:
                run.save({"x": x})
            if step == stop:
                raise KeyboardInterrupt
        run.finish(psnr=float(-10 * torch.log10(x**2)), **{"params.total": 1})
    return seen


def test_tracked_loop_goes_on_from_what_it_saved(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        descent(0.1, tmp_path, stop=8)
    (run,) = records.runs(tmp_path)
    assert records.state(run) == "interrupted"
    again, whole = descent(0.1, tmp_path), descent(0.1, tmp_path / "other")
    assert again == {step: whole[step] for step in range(6, LAST + 1)}  # bit for bit
    metrics = records.read_metrics(run)
    assert metrics["value"][metrics["key"] == "x"].tolist() == list(whole.values())
    assert metrics["time_s"].is_monotonic_increasing
    assert descent(0.1, tmp_path) == {}
    assert list(tmp_path.glob("descent*")) == [run]


def test_tracked_runs_stand_in_tables_beside_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for rate in (0.1, 0.2):
        for seed in range(2):
            descent(rate, tmp_path, seed)
    frame = load.runs(tmp_path, "field=descent")
    assert frame["state"].tolist() == ["finished"] * 4
    assert (frame["seed"].dtype, frame["train.steps"].dtype) == ("int64", "int64")
    with pytest.raises(ValueError, match=r"mixes runs of different train\.rate"):
        ablation(frame, ["scene_name", "field"])
    assert ablation(frame, ["scene_name", "field", "train.rate"]).markdown().count("| square | descent |") == 2
    table = ablation(frame, ["train.rate"], baseline={"train.rate": 0.1}).markdown()
    assert "worse" in table or "better" in table
    run = records.runs(tmp_path)[0]
    for command in (["show", str(run)], ["runs", "--store", str(tmp_path)]):
        assert main.dispatch(command[0], command[1:]) == 0
    assert "descent" in capsys.readouterr().out
    assert main.dispatch("reproduce", [str(run)]) == 2
    assert "only that loop goes on with it" in capsys.readouterr().err


def test_tracked_run_has_one_writer_and_its_own_checkpoints(tmp_path: Path) -> None:
    with qnerf.track({}, name="a", store=tmp_path) as run:
        assert run.record is not None
        run.record.save_checkpoint({"step": 1})
        with (
            pytest.raises(StoreError, match="already being written by process"),
            qnerf.track({}, name="a", store=tmp_path),
        ):
            pass
    with pytest.raises(StoreError, match="expected a step and a state"), qnerf.track({}, name="a", store=tmp_path):
        pass


def test_numbers_may_be_numpy_s_and_pytorch_s_but_a_seed_is_whole(tmp_path: Path) -> None:
    for seed in ("x", 1.5):
        with (
            pytest.raises(ValueError, match="seed: expected a whole number, got"),
            qnerf.track({"seed": seed}, name="a", store=tmp_path),
        ):
            pass
    assert not records.runs(tmp_path)
    with qnerf.track({"seed": np.int64(1)}, name="a", store=tmp_path) as run:
        run.log(1, loss=torch.ones((), requires_grad=True))
        run.finish(psnr=torch.tensor(20.0), ssim=np.float32(0.5))
        with pytest.raises(StoreError, match="finished already"):
            run.log(2, loss=1.0)
    assert (records.read_summary(run.path)["psnr"], records.read_summary(run.path)["seed"]) == (20.0, 1)
    assert qnerf.load("a-", store=tmp_path).eval()["ssim"].tolist() == [0.5]
