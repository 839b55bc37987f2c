"""Shared by all tests: composing the real configuration, a tiny scene, the optional data folder."""

import os

os.environ["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "PASSIVE")  # as the command line does: before PyTorch

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from PIL import Image

# Examples are the same in every run; how long one takes is nobody's promise.
hypothesis.settings.register_profile("suite", deadline=None, derandomize=True)
# `QNERF_HYPOTHESIS=long python -m pytest tests/numerics`: other examples each time, more than 10^5 over all of them.
hypothesis.settings.register_profile("long", deadline=None, max_examples=2500)
hypothesis.settings.load_profile(os.environ.get("QNERF_HYPOTHESIS", "suite"))

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
SWEEPS = ROOT / "sweeps"
DATA = ROOT.parent / "shared" / "data"

TINY = (
    "sampler.samples=[8,6]",
    "sampler.final=4",
    "sampler.levels=2",
    "sampler.log2_table_size=6",
    "sampler.max_resolutions=[24,32]",
)
"""A proposal sampler small enough for a unit test."""


def composed(*overrides: str, sweep: str = "") -> dict[str, Any]:
    """The resolved configuration that these overrides give on the command line, `-cd sweeps -cn sweep` where named."""
    return OmegaConf.to_container(_compose(overrides, sweep), resolve=True)  # type: ignore[return-value]


def swept(sweep: str) -> dict[str, str]:
    """What a file of sweeps/ sweeps over: option -> its values as the command line would give them."""
    return {key: str(values) for key, values in _compose((), sweep, hydra=True).hydra.sweeper.params.items()}


def _compose(overrides: Sequence[str], sweep: str, hydra: bool = False) -> DictConfig:
    search = [f"hydra.searchpath=[file://{CONF}]"] if sweep else []
    with initialize_config_dir(str(SWEEPS if sweep else CONF), version_base="1.3"):
        return compose(sweep or "config", [*overrides, *search], return_hydra_config=hydra)


@pytest.fixture
def config() -> Callable[..., dict[str, Any]]:
    return composed


def write_scene(folder: Path, views: int = 6, width: int = 8, height: int = 6, channels: int = 3) -> Path:
    """A nerfstudio folder: cameras on a ring that look at the origin, images of a smooth pattern."""
    (folder / "images").mkdir(parents=True)
    frames = []
    random = np.random.default_rng(0)
    for view in range(views):
        angle = 2 * np.pi * view / views
        centre = np.array([2 * np.cos(angle), 2 * np.sin(angle), 1.0])
        backward = centre / np.linalg.norm(centre)
        right = np.cross([0, 0, 1.0], backward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(backward, right), backward, centre], axis=1)
        pixels = random.integers(0, 255, (height, width, channels), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / "images" / f"{view:03d}.png")
        frames.append({"file_path": f"images/{view:03d}.png", "transform_matrix": pose.tolist()})
    transforms = {
        "w": width,
        "h": height,
        "fl_x": 8.0,
        "fl_y": 8.0,
        "cx": width / 2,
        "cy": height / 2,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(transforms))
    return folder


@pytest.fixture
def tiny_scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


@pytest.fixture
def tiny(tiny_scene: Path, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """A configuration that trains in a moment: `tiny("field=qboth")`."""

    def make(*overrides: str, sampler: Sequence[str] = TINY) -> dict[str, Any]:
        chosen = [item.split("=")[0] for item in overrides]
        scene = [] if "scene" in chosen else ["scene=nerfstudio", f"scene.path={tiny_scene}"]
        return composed(
            *scene,
            *(() if "sampler" in chosen else sampler),
            "hash=C7",
            "train.steps=2",
            "train.rays=8",
            "train.eval_every=0",
            "train.log_every=1",
            f"store={tmp_path / 'runs'}",
            "device=cpu",
            *overrides,
        )

    return make


@pytest.fixture
def run_until(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, dict[str, Any]], None]:
    """`run_until(step, config)` trains to that step and dies there: what is left is the last checkpoint."""

    def until(step: int, config: dict[str, Any]) -> None:
        from qnerf.experiment import run
        from qnerf.train import Trainer

        take_step = Trainer.take_step

        def dying(self: Trainer, measure: bool) -> dict[str, float]:
            if self.step == step:
                raise KeyboardInterrupt
            return take_step(self, measure)

        with monkeypatch.context() as patch:
            patch.setattr(Trainer, "take_step", dying)
            with pytest.raises(KeyboardInterrupt):
                run(config)

    return until


@pytest.fixture(autouse=True)
def _threads() -> None:
    torch.set_num_threads(min(2, torch.get_num_threads()))
