"""Posed images: the built-in scene, nerfstudio and instant-ngp folders, COLMAP, LLFF, the synthetic-NeRF layout."""

from qnerf.scenes import formats, poster  # each module registers its entry
from qnerf.scenes.base import SCENES, Cameras, Scene, split_views

__all__ = ["SCENES", "Cameras", "Scene", "formats", "poster", "split_views"]
