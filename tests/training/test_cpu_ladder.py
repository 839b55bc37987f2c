"""`benchmarks.cpu_ladder`: budgets, a benchmark that was stopped, the same rays for both sides, and its figure."""

import json
import sys
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from qnerf.analysis.figures import cpu_ladder_points, psnr_vs_cpu_seconds

from benchmarks import cpu_ladder
from benchmarks.peers.serve import Remote
from benchmarks.training import build
from qnerf.geometry.pose_refinement import CAMERAS
from tests.helpers.scenes import write_scene

A_STEP = 0.25  # seconds


class Model:
    """A served model whose steps take `A_STEP` seconds."""

    started: ClassVar[list[str]] = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def order(self, do, **values):
        seconds = values.get("count", 0) * A_STEP
        return {"seconds": 2 * seconds, "cpu": seconds}  # half of the time it waits


class Evaluator:
    def measure(self, view):
        return {"psnr": view, "ssim": 0.5}


@pytest.fixture
def ladder(monkeypatch, tmp_path):
    """Calls the command with all models replaced."""

    def start(self, case, overrides, seed):
        Model.started.append(overrides)
        return Model()

    Model.started = []
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
    assert cpu_ladder_points(rows)["psnr"].tolist() == [21.0, 21.0]
    (ax,) = psnr_vs_cpu_seconds(rows).axes
    (line,) = ax.containers
    assert line.lines[0].get_xydata().tolist() == [[15.0, 21.0], [30.0, 21.0]]
    assert Model.started[1].startswith("scene=poster scene.height=113 scene.width=64 field=classical seed=0")
    assert "train.steps=60 " in Model.started[1]


def test_a_stopped_benchmark_measures_what_is_missing(ladder):
    ladder("--budgets", "15", "--cases", "qnerf classical")
    before = len(Model.started)
    rows = ladder("--budgets", "15", "30", "--cases", "qnerf classical")
    assert len(Model.started) - before == 2  # timed, and trained for 30 s
    assert rows["budget_s"].tolist() == [15.0, 30.0]


SEED = 3


def test_both_sides_get_the_same_rays_colours_and_settings(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    overrides = "train=paper train.rays=16 hash=C3 train.steps=500 field=classical"
    trainer, evaluator = build(f"{overrides} seed={SEED} scene=nerfstudio scene.path={scene}")
    table = cpu_ladder.table_of(trainer, evaluator, SEED, 3)
    fixed = CAMERAS.build("fixed", len(evaluator.scene.cameras), evaluator.scene.train)
    generator = torch.Generator().manual_seed(SEED)
    for numbers in table["batches"]:
        rays, colors = trainer.table.batch(16, generator, fixed)
        views = numbers // len(trainer.table.view(0))
        assert np.array_equal(table["directions"][numbers], rays.directions)
        assert np.array_equal(table["origins"][views], rays.origins)
        assert np.array_equal(table["colors"][numbers] / np.float32(255), colors)
    assert table["held_out"].tolist() == evaluator.scene.eval
    settings = json.loads(json.dumps(cpu_ladder.settings_of(trainer, SEED, threads=1)))
    assert settings["table"] == [12, 16, 2048, 17, 2]
    assert settings["geo_features"] == 5
    assert (settings["samples"], settings["final"]) == ([256, 96], 48)
    assert (settings["rate"], settings["final_rate"], settings["steps"]) == (1e-2, 1e-2, 500)
    finest = [network["max_res"] for network in settings["options"]["proposal_net_args_list"]]
    assert finest == [128, 256]


SERVED = """
from benchmarks.peers.serve import serve
class Model:
    step = 0
    def take_step(self): self.step += 1; print("noise")
    def render(self, path): open(path, "w").write(str(self.step))
serve(Model)
"""


def test_a_served_model_follows_orders_and_one_that_cannot_start_says_why(tmp_path: Path) -> None:
    with Remote([sys.executable, "-c", SERVED], threads=1) as model:
        assert model.order("steps", count=3)["seconds"] > 0
        model.order("render", path=str(tmp_path / "step"))
    assert (tmp_path / "step").read_text() == "3"
    with pytest.raises(RuntimeError, match="No module named 'no_such_peer'"):
        Remote([sys.executable, "-c", "import no_such_peer"], threads=1)
