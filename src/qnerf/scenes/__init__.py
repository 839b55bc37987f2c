"""Posed images: the built-in scenes, nerfstudio and instant-ngp folders, COLMAP, LLFF, the synthetic-NeRF layout."""

from qnerf.scenes import builtin, formats  # each module registers its entry
from qnerf.scenes.base import SCENES, Cameras, Scene, split_views

__all__ = ["SCENES", "Cameras", "Scene", "builtin", "formats", "split_views"]
