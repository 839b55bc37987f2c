"""Posed images: the built-in room, nerfstudio and instant-ngp folders, the synthetic-NeRF layout."""

from qnerf.scenes import blender, nerfstudio, poster  # each registers its entry
from qnerf.scenes.base import SCENES, Cameras, Scene, split_views

__all__ = ["SCENES", "Cameras", "Scene", "blender", "nerfstudio", "poster", "split_views"]
