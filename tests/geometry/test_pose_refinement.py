import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.geometry.rotations import exp_se3, exp_so3, skew

REFINED = ["se3", "so3xr3"]
vectors = st.tuples(*[st.floats(-7, 7)] * 3)


def random_poses(count, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    turn = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    return torch.cat([exp_so3(turn), torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)], -1).to(dtype)


def exponential(matrix):
    """SciPy's: torch.matrix_exp is off by 2e-11 at 0.03 radians in float64."""
    return torch.from_numpy(expm(matrix.numpy()))


def twist_matrix(twist):
    top = torch.cat([skew(twist[3:]), twist[:3, None]], dim=-1)
    return torch.cat([top, torch.zeros(1, 4, dtype=twist.dtype)])


@given(vector=vectors, scale=st.sampled_from([0.0, 1e-12, 1e-6, 1e-3, 0.03, 0.1, 1.0]))
def test_exponentials_against_the_matrix_exponential(vector, scale):
    rotation = torch.tensor(vector, dtype=torch.float64) * scale
    torch.testing.assert_close(exp_so3(rotation), exponential(skew(rotation)), rtol=0, atol=1e-13)
    twist = torch.cat([torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64), rotation])
    torch.testing.assert_close(exp_se3(twist), exponential(twist_matrix(twist))[:3], rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", CAMERAS.names())
def test_poses_start_as_they_are(name):
    cameras = CAMERAS.build(name, 4, [0, 1, 3])
    poses = random_poses(3, torch.float32)
    found = cameras.poses(torch.tensor([0, 1, -1]), poses)
    assert torch.equal(found, poses)


@pytest.mark.parametrize("name", REFINED)
def test_only_training_views_move(name):
    cameras = CAMERAS.build(name, 5, [0, 2, 4]).double()
    assert cameras.motion.shape == (3, 6)
    with torch.no_grad():
        cameras.motion += torch.arange(1, 19, dtype=torch.float64).view(3, 6) / 20
    poses = random_poses(6)
    found = cameras.poses(torch.tensor([0, 1, 2, 3, 4, -1]), poses)
    moved = [not torch.equal(a, b) for a, b in zip(found, poses, strict=True)]
    assert moved == [True, False, True, False, True, False]


@pytest.mark.parametrize("name", REFINED)
def test_the_motion_acts_in_the_cameras_frame(name):
    cameras = CAMERAS.build(name, 1).double()
    with torch.no_grad():
        cameras.motion += torch.tensor([[0.1, 0.2, -0.3, 0.4, 0.5, -0.6]], dtype=torch.float64)
    pose = random_poses(1)
    motion = cameras.exponential(cameras.motion)

    def square(rigid):
        return torch.cat([rigid[0], torch.tensor([[0.0, 0, 0, 1]], dtype=torch.float64)])

    expected = (square(pose) @ square(motion))[:3]
    torch.testing.assert_close(cameras.poses(torch.tensor([0]), pose)[0], expected)


@pytest.mark.parametrize("name", REFINED)
def test_the_penalty_and_its_gradient_at_zero(name):
    cameras = CAMERAS.build(name, 2)
    penalty = cameras.penalty()
    penalty.backward()
    assert float(penalty.detach()) == 0
    assert bool((cameras.motion.grad == 0).all())
    with torch.no_grad():
        cameras.motion[0] = torch.tensor([3.0, 0, 4, 0, 0, 2])
    assert float(cameras.penalty().detach()) == pytest.approx((1e-2 * 5 + 1e-3 * 2) / 2)
