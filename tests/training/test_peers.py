"""`benchmarks.nerfstudio`: both sides get the same rays and settings, and a stopped benchmark continues."""

import json
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from benchmarks import nerfstudio
from benchmarks.peers.serve import Remote
from benchmarks.training import build
from qnerf.geometry.pose_refinement import CAMERAS
from tests.helpers.scenes import write_scene

SEED = 3


@pytest.fixture(scope="module")
def overrides(tmp_path_factory: pytest.TempPathFactory) -> str:
    scene = write_scene(tmp_path_factory.mktemp("data") / "scene")
    return f"train=paper train.rays=16 seed={SEED} scene=nerfstudio scene.path={scene}"


def test_both_sides_see_the_same_rays_and_colours(overrides: str) -> None:
    trainer, evaluator = build(f"{overrides} field=classical")
    table = nerfstudio.table_of(trainer, evaluator, SEED, 3)
    fixed = CAMERAS.build("fixed", len(evaluator.scene.cameras), evaluator.scene.train)
    generator = torch.Generator().manual_seed(SEED)
    for numbers in table["batches"]:
        rays, colors = trainer.table.batch(16, generator, fixed)
        views = numbers // len(trainer.table.view(0))
        assert np.array_equal(table["directions"][numbers], rays.directions)
        assert np.array_equal(table["origins"][views], rays.origins)
        assert np.array_equal(table["colors"][numbers] / np.float32(255), colors)
    assert table["held_out"].tolist() == evaluator.scene.eval


def test_nerfstudio_gets_our_settings(overrides: str) -> None:
    trainer, _ = build(f"{overrides} field=qcolor qiren=2L3S hash=C3 train.steps=500")
    settings = nerfstudio.settings_of(trainer, SEED, threads=1)
    assert settings["table"] == [12, 16, 2048, 17, 2]
    assert settings["circuit"] == [2, 3]
    assert settings["geo_features"] == 5
    assert (settings["samples"], settings["final"]) == ([256, 96], 48)
    assert (settings["rate"], settings["final_rate"], settings["steps"]) == (1e-2, 1e-2, 500)
    finest = [network["max_res"] for network in settings["options"]["proposal_net_args_list"]]
    assert finest == [128, 256]
    json.dumps(settings)


SERVED = """
from benchmarks.peers.serve import serve
class Model:
    step = 0
    def advance(self, step): self.step = step
    def take_step(self): self.step += 1; print("noise")
    def render(self, path): open(path, "w").write(str(self.step))
serve(Model)
"""


def test_a_served_model_follows_orders(tmp_path: Path) -> None:
    with Remote([sys.executable, "-c", SERVED], threads=1) as model:
        assert model.order("steps", count=3)["seconds"] > 0
        model.order("advance", step=10)
        model.order("steps", count=2)
        model.order("render", path=str(tmp_path / "step"))
        memory = model.order("memory")
    assert (tmp_path / "step").read_text() == "12"
    assert 0 <= memory["growth"] <= memory["peak"]


def test_a_model_that_cannot_start_says_why() -> None:
    with pytest.raises(RuntimeError, match="No module named 'no_such_peer'"):
        Remote([sys.executable, "-c", "import no_such_peer"], threads=1)


def test_saved_cases_are_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(nerfstudio, "RESULTS", tmp_path / "results.parquet")
    options = Namespace(overrides="", schedule=100, steps=[10, 20])

    def rows(case: str, steps: list[int], psnr: float) -> pd.DataFrame:
        common = {"kind": "quality", "case": case, "scene": "poster", "overrides": "", "schedule": 100, "seed": 0}
        return pd.DataFrame([{**common, "step": step, "image": "a.png", "psnr": psnr} for step in steps])

    def done(case: str, **changes: object) -> bool:
        return nerfstudio.has(case, "poster", 0, Namespace(**vars(options) | changes))

    assert not done("qnerf classical")
    nerfstudio.save(rows("qnerf classical", [10], 20.0))
    assert not done("qnerf classical")
    nerfstudio.save(rows("qnerf classical", [10, 20], 21.0))
    nerfstudio.save(rows("nerfstudio classical", [10], 22.0))
    assert done("qnerf classical")
    assert not done("qnerf classical", schedule=200)
    assert not done("nerfstudio classical")
    assert sorted(nerfstudio.stored()["psnr"]) == [21.0, 21.0, 22.0]
