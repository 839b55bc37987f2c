"""Posed images: the built-in room, nerfstudio and instant-ngp folders, COLMAP, LLFF, the synthetic-NeRF layout."""

from qnerf.scenes import blender, colmap, llff, nerfstudio  # each registers its entry
from qnerf.scenes.base import SCENES, Cameras, Scene, split_views
from qnerf.scenes.builtin import poster  # each registers its entry

__all__ = ["SCENES", "Cameras", "Scene", "blender", "colmap", "llff", "nerfstudio", "poster", "split_views"]
