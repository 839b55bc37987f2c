"""`benchmarks.cpu_ladder`: budgets are kept, a stopped benchmark continues, failures are named, and its figure."""

from typing import ClassVar

import pytest
from qnerf.analysis.figures import cpu_ladder_points, psnr_vs_cpu_seconds

from benchmarks import cpu_ladder

A_STEP = 0.25  # seconds


class Model:
    """A served model whose steps take `A_STEP` seconds, or twice that once `slow`."""

    slow = False
    started: ClassVar[list[str]] = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def order(self, do, **values):
        seconds = values.get("count", 0) * A_STEP * (2 if Model.slow else 1)
        return {"seconds": 2 * seconds, "cpu": seconds}  # half of the time it waits


class Evaluator:
    def measure(self, view):
        return {"psnr": view, "ssim": 0.5}


@pytest.fixture
def ladder(monkeypatch, tmp_path):
    """Calls the command with all models replaced; Nerfacto's environment lacks it."""

    def start(self, case, overrides, seed):
        Model.started.append(overrides)
        if case == "Nerfacto":
            raise RuntimeError("ModuleNotFoundError: No module named 'nerfstudio'")
        return Model()

    Model.started, Model.slow = [], False
    monkeypatch.setattr(cpu_ladder.Ladder, "start", start)
    monkeypatch.setattr(cpu_ladder, "build", lambda overrides: (None, Evaluator()))
    monkeypatch.setattr(cpu_ladder, "rendered", lambda evaluator, path: [20.0, 22.0])
    file = tmp_path / "ladder.parquet"

    def call(*arguments):
        cpu_ladder.main(["--widths", "64", "--out", str(file), "--threads", "1", *arguments])
        return cpu_ladder.stored(file)

    return call


def test_a_training_plans_the_steps_of_its_budget(ladder):
    rows = ladder("--budgets", "15", "30", "--cases", "qnerf classical")
    assert rows["planned"].tolist() == rows["steps"].tolist() == [60, 120]
    assert rows["psnr"].tolist() == [21.0, 21.0]
    assert Model.started[1].startswith("scene=poster scene.height=113 scene.width=64 field=classical seed=0")
    assert "train.steps=60 " in Model.started[1]


def test_a_model_that_slows_down_stops_within_a_block_of_the_budget(ladder, monkeypatch):
    monkeypatch.setattr(cpu_ladder.Ladder, "step_seconds", lambda *_: A_STEP)
    Model.slow = True
    (row,) = ladder("--budgets", "15", "--cases", "qnerf classical").to_dict("records")
    assert row["planned"] == 60
    assert 15 <= row["seconds"] < 15 + cpu_ladder.BLOCK * 2 * A_STEP
    assert row["steps"] == row["seconds"] / (2 * A_STEP)


def test_a_stopped_benchmark_measures_what_is_missing(ladder):
    ladder("--budgets", "15", "--cases", "qnerf classical")
    before = len(Model.started)
    rows = ladder("--budgets", "15", "30", "--cases", "qnerf classical")
    assert len(Model.started) - before == 2  # timed, and trained for 30 s
    assert rows["budget_s"].tolist() == [15.0, 30.0]


def test_what_cannot_be_trained_is_named_and_the_rest_is_drawn(ladder, capsys):
    rows = ladder("--budgets", "15", "30", "--cases", "Nerfacto", "qnerf classical")
    said = capsys.readouterr().out
    assert "Nerfacto: not trained on poster: ModuleNotFoundError: No module named 'nerfstudio'" in said
    assert cpu_ladder_points(rows)["case"].tolist() == ["qnerf classical"] * 2
    (ax,) = psnr_vs_cpu_seconds(rows).axes
    (line,) = ax.containers
    assert line.lines[0].get_xydata().tolist() == [[15.0, 21.0], [30.0, 21.0]]
