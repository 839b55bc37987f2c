"""Noise on training poses, to study how much of it pose refinement corrects."""

from dataclasses import replace

import torch

from qnerf.geometry.rotations import exp_so3
from qnerf.scenes.base import Scene


def add_pose_noise(scene: Scene, *, rotation: float, translation: float, seed: int) -> Scene:
    """The scene with noise on the poses of its training views. Held-out poses do not change.

    Args:
        rotation: standard deviation of each component of a rotation vector in the camera's frame, radians.
        translation: standard deviation of each coordinate of the centre, world units.
        seed: of the noise.
    """
    if rotation == translation == 0:
        return scene
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(len(scene.train), 6, dtype=torch.float64, generator=generator)
    poses = scene.cameras.poses.clone()
    turned = poses[scene.train, :, :3] @ exp_so3(rotation * noise[:, :3])
    moved = poses[scene.train, :, 3] + translation * noise[:, 3:]
    poses[scene.train] = torch.cat([turned, moved[..., None]], dim=-1)
    return replace(scene, cameras=replace(scene.cameras, poses=poses))
