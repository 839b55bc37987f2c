"""Scenes small enough for a unit test."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from qnerf.building.components import component
from qnerf.config.settings import Settings
from qnerf.geometry.pose_noise import add_pose_noise
from qnerf.scenes import SCENES, Scene


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


def change(folder: Path, edit: Callable[[dict[str, Any]], object], file: str = "transforms.json") -> None:
    """Edits the content of the folder's JSON file."""
    content = json.loads((folder / file).read_text())
    edit(content)
    (folder / file).write_text(json.dumps(content))


def change_frame(folder: Path, view: int = 2, /, **keys: Any) -> None:
    """Sets keys of one frame of the folder's transforms.json."""
    change(folder, lambda content: content["frames"][view].update(keys))


def build(kind: str, folder: Path, **options: Any) -> Scene:
    return SCENES.build(kind, path=str(folder), **options)


def refused(kind: str, folder: Path, *needles: str, **options: Any) -> str:
    """The message, of one line, with which the folder is refused."""
    with pytest.raises(ValueError) as error:  # noqa: PT011
        build(kind, folder, **options)
    message = str(error.value)
    assert "\n" not in message
    for needle in needles:
        assert needle in message, message
    return message


def build_scene(settings: Settings) -> Scene:
    """The scene of checked settings, as a run reads it."""
    return add_pose_noise(component(SCENES, settings.scene), **vars(settings.pose_noise))
