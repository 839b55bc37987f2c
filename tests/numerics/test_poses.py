"""Pose refinement at zero, at pi, after many turns and after many steps."""

import math

import pytest
import torch
from hypothesis import given, target
from hypothesis import strategies as st

from benchmarks.accuracy_cases import EPS, rounded
from benchmarks.accuracy_cases.geometry import MOTION, ROTATION
from qnerf.geometry.rotations import exp_se3, exp_so3, exp_so3xr3
from tests.helpers.hard_inputs import seeds

ANGLE_GRADIENTS = 1e-4
"""Relative to the largest derivative, up to a turn: what is asked for."""
TURNS = 2 * EPS
"""Of the angle, relative: its square and the square root are rounded. Within one turn MOTION has it."""

ANGLES = st.sampled_from([0.0, 1e-30, 1e-20, 1e-7, math.pi / 2, math.pi, 2 * math.pi, 1e3, 1e6, 1e7, 1e18]) | st.floats(
    0, 7
)
AXES = st.tuples(*[st.floats(-1, 1, width=32)] * 3).filter(lambda axis: math.hypot(*axis) > 1e-3)


def vector(axis, angle):
    return rounded([angle * x / math.hypot(*axis) for x in axis])


@given(axis=AXES, angle=ANGLES)
def test_rotations_of_any_angle(axis, angle):
    """Orthogonal, right up to the rounding of the angle, with a finite gradient: no 0/0, no infinity times 0."""
    turn = vector(axis, angle).float().requires_grad_()
    rotation = exp_so3(turn)
    drift = float((rotation @ rotation.T - torch.eye(3)).detach().abs().max())
    target(drift)
    assert drift <= ROTATION
    error = float((rotation.detach().double() - exp_so3(turn.detach().double())).abs().max())
    assert error <= MOTION + TURNS * angle
    (gradient,) = torch.autograd.grad(rotation[0, 1] + rotation[1, 2] - rotation[2, 2], turn)
    assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("exponential", [exp_so3xr3, exp_se3])
@given(axis=AXES, angle=st.sampled_from([0.0, 1e-20, 1e-7, 0.03, math.pi, 2 * math.pi]) | st.floats(0, 7), seed=seeds)
def test_gradients_of_motions_up_to_a_turn(exponential, axis, angle, seed):
    generator = torch.Generator().manual_seed(seed)
    motion = torch.cat([rounded(torch.randn(3, generator=generator)), vector(axis, angle)])
    upstream = rounded(torch.randn(3, 4, generator=generator))
    found = []
    for dtype in (torch.float32, torch.float64):
        leaf = motion.to(dtype).requires_grad_()
        moved = exponential(leaf)
        found.append((moved.detach().double(), torch.autograd.grad(moved, leaf, upstream.to(dtype))[0].double()))
    largest = [float(exact.abs().max()) for exact in found[1]]
    assert float((found[0][0] - found[1][0]).abs().max()) <= (MOTION + TURNS * angle) * max(largest[0], 1)
    error = float((found[0][1] - found[1][1]).abs().max()) / largest[1]
    target(error)
    assert error <= ANGLE_GRADIENTS
