"""Occupancy learnt in training: what it closes, what it opens again, and that a resumed run repeats it."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.visibility import cell_centres
from qnerf.heads.qiren import QirenHead
from qnerf.model.occupancy import CHUNK, Occupancy, reachable, shortest_sides
from qnerf.training.trainer import Trainer
from tests.helpers.trainer import trainer

N = 12
ALL = torch.ones(N, N, N, dtype=torch.bool)


class Blobs(torch.nn.Module):
    """A field with density inside balls of the unit cube: (centre, radius) each."""

    def __init__(self, *balls: tuple[tuple[float, float, float], float], density: float = 200.0) -> None:
        super().__init__()
        self.balls, self.density = balls, density
        self.seen: list[torch.Tensor] = []

    def density_anywhere(self, unit: torch.Tensor) -> torch.Tensor:
        assert not self.training
        self.seen.append(unit)
        inside = [(unit - torch.tensor(centre)).norm(dim=-1) < radius for centre, radius in self.balls]
        return self.density * torch.stack(inside).any(0).float()


def occupancy(allowed: torch.Tensor = ALL, contraction: str = "box", **options) -> Occupancy:
    return Occupancy(
        allowed, CONTRACTIONS.build(contraction), **{"every": 5, "after": 10, "min_opacity": 0.01, **options}
    )


def looked(mask: Occupancy, field: torch.nn.Module, times: int = 1, seed: int = 0) -> Occupancy:
    generator = torch.Generator().manual_seed(seed)
    for _ in range(times):
        mask.look(field, generator)
    return mask


def near(centre: tuple[float, float, float], distance: float) -> torch.Tensor:
    """Cells (n, n, n) whose centre is at most so far from a point of the unit cube."""
    return ((cell_centres(N) - torch.tensor(centre)).norm(dim=-1) <= distance).view(N, N, N)


MIDDLE, CORNER = (0.5, 0.5, 0.5), (0.2, 0.2, 0.2)


@pytest.mark.parametrize("contraction", CONTRACTIONS.names())
def test_it_closes_what_is_empty_and_keeps_what_is_not_with_its_neighbours(contraction):
    mask = looked(occupancy(contraction=contraction), Blobs((MIDDLE, 0.2)))
    assert bool(mask.grid[near(MIDDLE, 0.2)].all())
    assert not bool(mask.grid[~near(MIDDLE, 0.2 + 2 * 3**0.5 / N)].any())


def test_it_opens_again_where_the_field_grows():
    mask = looked(occupancy(), Blobs((MIDDLE, 0.15)))
    assert not bool(mask.grid[near(CORNER, 0.05)].any())
    looked(mask, Blobs((MIDDLE, 0.15), (CORNER, 0.15)))
    assert bool(mask.grid[near(CORNER, 0.1)].all())


def test_what_was_seen_fades_by_look_and_not_at_once():
    gone = Blobs((CORNER, 0.15), density=20.0)
    mask = looked(occupancy(min_opacity=0.3), Blobs((MIDDLE, 0.15), (CORNER, 0.15)))
    assert bool(mask.grid[near(MIDDLE, 0.1)].all())
    seen = float(mask.opacity.max())
    assert seen > 0.99
    open_for = 0
    while bool(mask.grid[near(MIDDLE, 0.1)].all()):
        looked(mask, gone)
        open_for += 1
    assert seen * 0.7**open_for < 0.3 <= seen * 0.7 ** (open_for - 1)
    assert bool(mask.grid[near(CORNER, 0.1)].all())


@settings(max_examples=40)
@given(seed=st.integers(0, 2**20), least=st.floats(1e-4, 0.99), share=st.floats(0.05, 1))
def test_it_never_opens_what_is_not_allowed(seed, least, share):
    generator = torch.Generator().manual_seed(seed)
    allowed = torch.rand(N, N, N, generator=generator) < share
    allowed[0, 0, 0] = True
    centre = tuple(torch.rand(3, generator=generator).tolist())
    mask = occupancy(allowed, min_opacity=least)
    for _ in range(3):
        mask.look(Blobs((centre, 0.3)), generator)
        assert not bool((mask.grid & ~allowed).any())
        assert bool(mask.grid.any())


def test_a_field_that_is_empty_everywhere_closes_nothing():
    """Cells of a contracted cube reach to infinity; that does not make the least density opaque there."""
    for contraction in CONTRACTIONS.names():
        for density in (0.0, 1e-6):
            mask = looked(occupancy(contraction=contraction), Blobs((MIDDLE, 9.0), density=density), times=3)
            assert torch.equal(mask.grid, ALL)


def test_only_allowed_cells_are_looked_at_each_in_a_place_of_its_own():
    allowed = near(MIDDLE, 0.3)
    mask, field = occupancy(allowed), Blobs((MIDDLE, 0.2))
    looked(mask, field, times=2)
    first, second = field.seen
    cells = (first * N).long()
    assert torch.equal(cells, allowed.nonzero())
    assert torch.equal(cells, (second * N).long())
    assert not torch.equal(first, second)


def test_many_cells_are_looked_at_in_parts():
    n = 34
    mask, field = occupancy(torch.ones(n, n, n, dtype=torch.bool)), Blobs((MIDDLE, 0.2))
    looked(mask, field)
    assert [len(points) for points in field.seen] == [CHUNK, n**3 - CHUNK]


def test_the_sides_of_cells_are_lengths_in_the_world():
    box = shortest_sides(CONTRACTIONS.build("box", half_extent=1.5), N)
    torch.testing.assert_close(box, torch.full_like(box, 3 / N))
    for name in ("linf", "l2"):
        contraction = CONTRACTIONS.build(name)
        there = reachable(contraction, N)
        sides, centres = shortest_sides(contraction, N)[there], contraction.inverse(cell_centres(N))[there]
        within = centres.abs().amax(1) < 0.5
        torch.testing.assert_close(sides[within], torch.full_like(sides[within], 4 / N))
        assert float(sides.max()) < 8 * N
        assert (name == "l2") == (not bool(there.all()))


def learning(tiny, *overrides: str) -> Trainer:
    return trainer(tiny("field=qboth", "qiren=1L1S", "qiren.qubits=2", "visibility.resolution=8", *overrides))


def test_a_training_looks_at_these_steps_and_the_sampler_sees_it(tiny, monkeypatch):
    steps = []
    monkeypatch.setattr(Occupancy, "look", lambda self, field, generator: steps.append(taken.step))
    taken = learning(tiny, "train.steps=9", "occupancy.every=3", "occupancy.after=2")
    for _ in range(9):
        taken.take_step(measure=False)
    assert steps == [2, 5, 8]
    assert isinstance(taken.model.field.mask, Occupancy)
    assert taken.model.sampler.mask is taken.model.field.mask


def test_a_look_leaves_the_heads_running_statistics_and_their_mode_alone(tiny):
    taken = learning(tiny, "occupancy.every=1", "occupancy.after=0")
    field, mask = taken.model.field, taken.model.field.mask
    taken.take_step(measure=False)
    before = {name: value.clone() for name, value in field.density_head.state_dict().items()}
    assert any(isinstance(module, QirenHead) for module in field.modules())
    assert any("running" in name for name in before)
    mask.look(field, torch.Generator().manual_seed(0))
    after = field.density_head.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert all(module.training for module in field.modules())
