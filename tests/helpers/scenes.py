"""Scenes small enough for a unit test."""

import json

import numpy as np
import pytest
import torch

from qnerf.scenes import SCENES
from tests.helpers.worlds import cameras, ring, scene, write


def write_scene(folder, views=6, width=8, height=6, channels=3):
    """A nerfstudio folder: cameras on a ring that look at the origin, images of noise."""
    of = cameras(ring(views, radius=2.0, height=1.0), width, height, focal=8.0)
    pixels = np.random.default_rng(0).integers(0, 255, (views, height, width, channels), dtype=np.uint8)
    return write(scene(torch.from_numpy(pixels), of), folder)


def change(folder, edit, file="transforms.json"):
    """Edits the content of the folder's JSON file."""
    content = json.loads((folder / file).read_text())
    edit(content)
    (folder / file).write_text(json.dumps(content))


def change_frame(folder, view=2, /, **keys):
    """Sets keys of one frame of the folder's transforms.json."""
    change(folder, lambda content: content["frames"][view].update(keys))


def build(kind, folder, **options):
    return SCENES.build(kind, path=str(folder), **options)


def refused(kind, folder, *needles, **options):
    """The message, of one line, with which the folder is refused."""
    with pytest.raises(ValueError) as error:  # noqa: PT011
        build(kind, folder, **options)
    message = str(error.value)
    assert "\n" not in message
    for needle in needles:
        assert needle in message, message
    return message
