import pytest
import torch

from qnerf.building.model import build_field
from qnerf.geometry.visibility import SpaceMask
from qnerf.model.field import Field
from qnerf.rendering.render import color_shares, render, volume_weights
from qnerf.rendering.shading import SHADINGS
from qnerf.types import Rays, Samples
from tests.helpers.configs import worked_out


@pytest.fixture
def field():
    torch.manual_seed(0)
    settings = worked_out("field=qboth", "encoder=none", "appearance=2", "hash=C7").settings
    return build_field(settings, views=4, trained=[0, 1, 3]).eval()


@pytest.fixture
def points():
    return torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(1))


DIRECTIONS = torch.nn.functional.normalize(torch.arange(15.0).view(5, 3) - 6, dim=-1)


def test_field_values_have_their_shapes_and_ranges(field, points):
    density, color = field(points, DIRECTIONS, torch.arange(5) % 4)
    assert density.shape == (5, 7)
    assert color.shape == (5, 7, 3)
    assert (density >= 0).all()
    assert ((color > 0) & (color < 1)).all()
    torch.testing.assert_close(field.density(points), density)


def test_a_look_at_the_density_leaves_what_a_head_knows_of_its_inputs(field, points):
    before = {name: value.clone() for name, value in field.state_dict().items()}
    field.train().density(points)
    assert field.density_head.training
    assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items())


def test_density_does_not_see_the_direction_and_colour_does(field, points):
    cameras = torch.zeros(5, dtype=torch.int64)
    density, color = field(points, DIRECTIONS, cameras)
    other_density, other_color = field(points, -DIRECTIONS, cameras)
    assert torch.equal(density, other_density)
    assert not torch.allclose(color, other_color)


def test_samples_do_not_depend_on_their_neighbours_in_evaluation(field, points):
    cameras = torch.zeros(5, dtype=torch.int64)
    _, color = field(points, DIRECTIONS, cameras)
    _, alone = field(points[2:3, 3:4], DIRECTIONS[2:3], cameras[2:3])
    torch.testing.assert_close(alone[0, 0], color[2, 3])


def test_a_view_without_an_embedding_gets_the_mean_of_the_trained_ones(field, points):
    none = torch.full((5,), -1)
    _, unknown = field(points, DIRECTIONS, none)
    with torch.no_grad():
        field.appearance.weight[:] = field.appearance.weight[[0, 1, 3]].mean(0)
    _, mean = field(points, DIRECTIONS, torch.arange(5) % 4)
    torch.testing.assert_close(unknown, mean)


def masked(field, grid):
    """Density, geometry, the rendering on last_sample and on white, and the gradients of both, with the mask."""
    generator = torch.Generator().manual_seed(2)
    edges = torch.rand(6, 9, dtype=torch.float64, generator=generator).mul(4).sort(-1).values
    origins = 0.5 * torch.randn(6, 3, dtype=torch.float64, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(6, 3, dtype=torch.float64, generator=generator), dim=-1)
    rays = Rays(origins, directions, torch.arange(6) % 4, edges[:, :1], edges[:, -1:])
    samples = Samples(edges, edges)
    field.mask = SpaceMask(grid)
    density, geometry, evaluated = field.geometry(rays.along(samples.mids))
    weights = volume_weights(density, samples.deltas)
    found = [density, geometry * evaluated[..., None], evaluated]
    for background in ("last_sample", "white"):
        field.zero_grad()
        shaded = SHADINGS.build("none")(color_shares(weights, background), geometry, evaluated)
        color = field.color(shaded.geometry, rays.directions, rays.cameras, shaded.mask)
        rendering, _ = render(weights, color, samples, background=background, shares=shaded.shares)
        rendering.color.square().sum().backward(retain_graph=True)
        found += [rendering.color, *(p.grad.clone() for p in field.parameters() if p.grad is not None)]
    return found


class Everywhere(Field):
    """The reference: all samples are evaluated, and multiplied by the mask."""

    def geometry(self, points):
        mask, self.mask = self.mask, None
        density, geometry, _ = super().geometry(points)
        self.mask = mask
        inside = mask(self.contraction(points))
        evaluated = inside.clone()
        evaluated[:, -1] = True
        return density * inside, geometry, evaluated


def test_a_masked_field_is_the_whole_one_times_the_mask():
    """An MLP field: circuit heads normalise by the samples that they get."""
    for encoder in ("none", "hash"):
        for share in (0.0, 0.3, 1.0):
            options = ["field=classical", f"encoder={encoder}", "appearance=2", "hash=C7", "density.initial=3"]
            torch.manual_seed(0)
            field = build_field(worked_out(*options).settings, views=4, trained=[0, 1, 2]).double()
            with torch.no_grad():
                for parameter in field.encoder.parameters():
                    parameter.uniform_(-1, 1)
            grid = torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)) < share
            spared = masked(field, grid)
            field.__class__ = Everywhere
            everywhere = masked(field, grid)
            assert len(spared) == len(everywhere) > 10
            for a, b in zip(spared, everywhere, strict=True):
                torch.testing.assert_close(a.double(), b.double() * (spared[2][..., None] if b is everywhere[1] else 1))
            assert bool(spared[2][:, -1].all())
            assert bool(spared[2].all()) == (share == 1.0)


def test_heads_see_the_evaluated_samples_alone_and_each_ray_keeps_its_last(field, points):
    seen = []
    for head in (field.density_head, field.color_head):
        head.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
    grid = torch.zeros(2, 2, 2, dtype=torch.bool)
    grid[1] = True
    field.mask = SpaceMask(grid)
    density, geometry, evaluated = field.geometry(points)
    inside = points[..., 0] > 0
    assert torch.equal(evaluated[:, :-1], inside[:, :-1])
    assert bool(evaluated[:, -1].all())
    assert not bool(geometry[~evaluated].any())
    assert bool((density[~inside] == 0).all())
    color = field.color(geometry, DIRECTIONS, torch.zeros(5, dtype=torch.int64), evaluated)
    assert seen == [int(evaluated.sum())] * 2
    assert not bool(color[~evaluated].any())
    assert bool((color[evaluated] > 0).all())


def test_an_infinite_density_where_none_may_be_is_none(field, points):
    field.mask = SpaceMask(torch.zeros(2, 2, 2, dtype=torch.bool))
    field.density_activation = lambda raw: torch.full_like(raw, float("inf"))
    assert torch.equal(field.density(points), torch.zeros(5, 7))


def test_initial_scales_the_density(points):
    fields = []
    for initial in (1.0, 0.1):
        torch.manual_seed(0)
        fields.append(
            build_field(worked_out("encoder=none", f"density.initial={initial}").settings, views=1, trained=[0]).eval()
        )
    torch.testing.assert_close(0.1 * fields[0].density(points), fields[1].density(points))
