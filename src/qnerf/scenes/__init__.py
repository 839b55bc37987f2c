"""Posed images: the built-in room, nerfstudio and instant-ngp folders, the synthetic-NeRF layout."""

from qnerf.scenes import blender, nerfstudio  # each registers its entry
from qnerf.scenes.base import SCENES, Cameras, Scene, split_views
from qnerf.scenes.builtin import poster  # each registers its entry

__all__ = ["SCENES", "Cameras", "Scene", "blender", "nerfstudio", "poster", "split_views"]
