"""The colour behind the scene: what a ray shows where nothing stops it."""

import torch
from torch import Tensor

from qnerf.config import bounds
from qnerf.config.settings import BACKGROUNDS, Background


def evaluation_background(name: str) -> str:
    """The background of evaluation: `random` helps training to empty space, evaluation then uses white."""
    return "white" if name == "random" else name


def background_color(name: str, like: Tensor, generator: torch.Generator | None) -> Tensor | None:
    """Colours (R, 3) in [0, 1] behind R rays, in the dtype and on the device of `like` (R, ...).

    >>> background_color("white", torch.zeros(2, 48), None).tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]

    Returns:
        None for `last_sample`: the colour of each ray's last sample then continues to infinity.

    Raises:
        ValueError: an unknown name, or `random` without a generator.
    """
    if name not in BACKGROUNDS:
        bounds.check("background", name, Background)
    if name == "last_sample":
        return None
    if name != "random":
        return like.new_full((len(like), 3), 1.0 if name == "white" else 0.0)
    if generator is None:
        raise ValueError("background=random needs a generator; evaluate on white or black")
    return torch.rand(len(like), 3, dtype=like.dtype, device=generator.device, generator=generator).to(like.device)
