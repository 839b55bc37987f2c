import pytest
import torch

from qnerf.rendering.spacing import SPACINGS

NAMES = SPACINGS.names()
BOUNDS = [(0.05, 1000.0), (0.05, 1e6), (0.3, 0.9), (2.0, 6.0), (1.0, 4.0), (0.5, 1.0)]


def bounds(near, far, dtype=torch.float64):
    return torch.tensor([[near]], dtype=dtype), torch.tensor([[far]], dtype=dtype)


CURVES = {
    "uniform": lambda t: t,
    "disparity": lambda t: -1 / t,
    "geometric": torch.log,
    "piecewise": lambda t: torch.where(t < 1, t / 2, 1 - 1 / (2 * t)),
}


def test_spacings_have_the_ends_and_even_steps_of_their_curves():
    near, far = torch.tensor(BOUNDS, dtype=torch.float64).split(1, dim=1)
    s = torch.linspace(0, 1, 1001, dtype=torch.float64).expand(len(BOUNDS), -1)
    for name in NAMES:
        t = SPACINGS.build(name, near, far).to_world(s)
        torch.testing.assert_close(t[:, [0, -1]], torch.cat([near, far], dim=1), rtol=1e-12, atol=0)
        first, last = CURVES[name](t[:, :1]), CURVES[name](t[:, -1:])
        torch.testing.assert_close((CURVES[name](t) - first) / (last - first), s, rtol=0, atol=1e-9)


def test_spacings_take_near_0_and_far_a_million():
    for name in ("uniform", "piecewise"):
        for dtype in (torch.float32, torch.float64):
            spacing = SPACINGS.build(name, *bounds(0.0, 1e6, dtype))
            t = spacing.to_world(torch.linspace(0, 1, 257, dtype=dtype)[None])
            assert t[0, 0] == 0
            assert t[0, -1] == pytest.approx(1e6)
            assert bool(torch.isfinite(t).all())
            assert bool((t.diff() > 0).all())


@pytest.mark.parametrize("name", ["disparity", "geometric"])
def test_near_zero_is_refused_where_it_is_undefined(name):
    with pytest.raises(ValueError, match=f"spacing={name} needs near above 0, got 0"):
        SPACINGS.build(name, *bounds(0.0, 10.0))
