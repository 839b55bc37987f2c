import pytest
import torch

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.visibility import SpaceMask
from qnerf.rendering.render import volume_weights
from qnerf.rendering.samplers import SAMPLERS, even_edges
from qnerf.training.losses import interlevel
from qnerf.types import Rays

NAMES = SAMPLERS.names()
SMALL = {"samples": [16, 12], "final": 8, "levels": 2, "max_resolutions": [24, 32], "log2_table_size": 8}
DTYPES = [torch.float32, torch.float64]


def make(name, dtype=torch.float32, **options):
    torch.manual_seed(0)
    sizes = {"proposal": SMALL, "vanilla": {"coarse": 8, "fine": 12}}.get(name, {"samples": 10})
    return SAMPLERS.build(name, CONTRACTIONS.build("linf"), **(sizes | options)).to(dtype)


def make_rays(count=5, dtype=torch.float32, near=0.05, far=1000.0):
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    origins = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    bounds = (torch.full((count, 1), bound, dtype=dtype) for bound in (near, far))
    return Rays(origins.to(dtype), directions.to(dtype), torch.zeros(count, dtype=torch.int64), *bounds)


def shell(points):
    """Density of an opaque shell of radius 2 to 2.5."""
    radius = points.norm(dim=-1)
    return ((radius > 2) & (radius < 2.5)).to(points.dtype) * 30


COUNTS = {"proposal": 8, "vanilla": 20}


def test_samples_have_the_dtype_of_the_rays_and_no_gradient():
    for dtype in DTYPES:
        for jitter in (False, True):
            for name in NAMES:
                generator = torch.Generator().manual_seed(0) if jitter else None
                sampler = make(name, dtype)
                found = sampler(make_rays(dtype=dtype), shell, generator=generator, step=0)
                assert found.samples.mids.shape == (5, sampler.rendered_samples) == (5, COUNTS.get(name, 10))
                for samples, _ in [(found.samples, None), *found.proposals]:
                    for edges in (samples.edges, samples.spacing):
                        assert edges.dtype == dtype
                        assert not edges.requires_grad


@pytest.mark.parametrize("name", NAMES)
def test_jitter_of_a_sampler_follows_its_generator(name):
    sampler, rays = make(name), make_rays()

    def edges(seed):
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        return sampler(rays, shell, generator=generator, step=3).samples.edges

    assert torch.equal(edges(None), edges(None))
    assert torch.equal(edges(7), edges(7))
    assert not torch.equal(edges(7), edges(8))
    assert not torch.equal(edges(7), edges(None))


def test_rays_do_not_depend_on_their_neighbours():
    for name in NAMES:
        sampler, rays = make(name), make_rays()
        whole = sampler(rays, shell, step=2000).samples.edges
        part = sampler(rays[1:3], shell, step=2000).samples.edges
        torch.testing.assert_close(part, whole[1:3], rtol=1e-6, atol=0)


def test_even_edges_stay_between_the_midpoints_beside_them():
    rays = make_rays(200, torch.float64)
    jitter = torch.rand(200, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    edges = even_edges(rays, 4, jitter)
    low = torch.tensor([0, 0.125, 0.375, 0.625, 0.875], dtype=torch.float64)
    high = torch.tensor([0.125, 0.375, 0.625, 0.875, 1], dtype=torch.float64)
    assert bool((edges >= low).all())
    assert bool((edges <= high).all())
    torch.testing.assert_close(edges[:, 1:-1].diff(), torch.full((200, 2), 0.25, dtype=torch.float64))
    torch.testing.assert_close(even_edges(rays, 4, None)[0], torch.linspace(0, 1, 5, dtype=torch.float64))


def test_vanilla_looks_where_the_density_is():
    rays = make_rays(20, near=0.05, far=10.0)
    sampler = make("vanilla", coarse=64, fine=64)
    fine = sampler(rays, shell, step=0).samples
    inside = shell(rays.along(fine.mids)) > 0
    even = make("uniform", samples=128)(rays, shell, step=0).samples
    assert float(inside.double().mean()) > 3 * float((shell(rays.along(even.mids)) > 0).double().mean())


def test_proposals_learn_where_the_density_is():
    torch.set_num_threads(1)  # in many steps on tiny tensors a second one only costs
    rays = make_rays(64, near=0.05, far=10.0)
    sampler = make("proposal", samples=[32, 24], final=16, log2_table_size=12, anneal_steps=0)
    optimiser = torch.optim.Adam(sampler.parameters(), lr=1e-2)
    generator = torch.Generator().manual_seed(0)
    before = float((shell(rays.along(sampler(rays, shell).samples.mids)) > 0).double().mean())
    for _ in range(60):
        found = sampler(rays, shell, generator=generator, step=0)
        weights = volume_weights(shell(rays.along(found.samples.mids)), found.samples.deltas)
        optimiser.zero_grad()
        interlevel(found.samples, weights, found.proposals).backward()
        optimiser.step()
    after = float((shell(rays.along(sampler(rays, shell).samples.mids)) > 0).double().mean())
    assert after > 2 * before


def test_proposals_learn_in_the_steps_that_the_schedule_names():
    sampler = make("proposal", update_every=5)
    assert [step for step in range(31) if sampler.learns(step)] == [*range(10), 14, 19, 24, 29]
    every = make("proposal", update_every=1)
    assert all(every.learns(step) for step in range(50))
    for step in (9, 14, 15):
        found = sampler(make_rays(), shell, step=step)
        assert [weights.requires_grad for _, weights in found.proposals] == [sampler.learns(step)] * 2
    with torch.no_grad():
        assert not sampler(make_rays(), shell, step=9).proposals[0][1].requires_grad


def test_the_mask_empties_proposals():
    sampler = make("proposal")
    sampler.mask = half_space()
    rays = make_rays()
    for step in (0, 12):  # a step in which the networks learn, and one in which they do not
        samples, weights = sampler(rays, shell, step=step).proposals[0]
        allowed = rays.along(samples.mids)[..., 0] > 0
        assert bool((weights[~allowed] == 0).all())
        assert bool((weights[allowed] > 0).any())


def half_space():
    grid = torch.zeros(4, 4, 4, dtype=torch.bool)
    grid[2:] = True
    return SpaceMask(grid)


BAD = {
    "known: disparity, geometric, piecewise, uniform": ("vanilla", {"spacing": "log"}),
    "one number per network": ("proposal", {"samples": [8]}),
}


def test_samplers_refuse_bad_options():
    for message, (name, options) in BAD.items():
        with pytest.raises(ValueError, match=message):
            make(name, **options)
