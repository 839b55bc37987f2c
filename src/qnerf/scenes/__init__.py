"""Posed images: the built-in room, nerfstudio and instant-ngp folders, COLMAP, LLFF, the synthetic-NeRF layout."""

from qnerf.scenes import formats  # each of its modules registers its entry
from qnerf.scenes.base import SCENES, Cameras, Scene, split_views
from qnerf.scenes.builtin import poster  # registers its entry

__all__ = ["SCENES", "Cameras", "Scene", "formats", "poster", "split_views"]
