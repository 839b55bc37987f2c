import pytest
import torch

from qnerf.geometry.pose_noise import add_pose_noise
from qnerf.scenes import SCENES
from tests.helpers.scenes import write_scene


@pytest.fixture
def scene(tmp_path):
    return SCENES.build("nerfstudio", path=str(write_scene(tmp_path / "ring", views=40)))


def test_training_poses_get_the_noise_that_is_asked_for_and_held_out_ones_none(scene):
    noisy = add_pose_noise(scene, rotation=0.02, translation=0.05, seed=0)
    before, after = scene.cameras.poses, noisy.cameras.poses
    assert torch.equal(before[scene.eval], after[scene.eval])
    moved = after[scene.train, :, 3] - before[scene.train, :, 3]
    assert float(moved.std()) == pytest.approx(0.05, rel=0.2)
    between = before[scene.train, :, :3].mT @ after[scene.train, :, :3]
    torch.testing.assert_close(between @ between.mT, torch.eye(3, dtype=torch.float64).expand_as(between))
    angles = torch.arccos((between.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(max=3) - 1) / 2)
    assert float(angles.square().mean().sqrt()) == pytest.approx(0.02 * 3**0.5, rel=0.2)


def test_the_same_seed_gives_the_same_noise_and_none_gives_the_scene(scene):
    first, again, other = (add_pose_noise(scene, rotation=0.01, translation=0.0, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(first.cameras.poses, again.cameras.poses)
    assert not torch.equal(first.cameras.poses, other.cameras.poses)
    assert add_pose_noise(scene, rotation=0.0, translation=0.0, seed=1) is scene
