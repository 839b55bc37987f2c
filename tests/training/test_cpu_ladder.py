"""`benchmarks.cpu_ladder`: the same rays for both sides, models that are served, and its figure."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from qnerf.analysis.figures import cpu_ladder_points, psnr_vs_cpu_seconds

from benchmarks import cpu_ladder
from benchmarks.peers.serve import Remote
from benchmarks.training import build
from qnerf.geometry.pose_refinement import CAMERAS
from tests.helpers.scenes import write_scene

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


def test_the_figure_leaves_out_what_could_not_be_trained() -> None:
    rows = pd.DataFrame({"case": ["Nerfacto", "qnerf classical", "qnerf classical"], "budget_s": [15.0, 15.0, 30.0]})
    rows = rows.assign(seconds=rows["budget_s"], psnr=[math.nan, 21.0, 22.0])
    rows = rows.assign(scene="poster", width=64, threads=1, load=0)
    assert cpu_ladder_points(rows)["case"].tolist() == ["qnerf classical"] * 2
    (ax,) = psnr_vs_cpu_seconds(rows).axes
    (line,) = ax.containers
    assert line.lines[0].get_xydata().tolist() == [[15.0, 21.0], [30.0, 22.0]]
