import pytest
import torch
from conftest import composed

from qnerf.config import settings_from
from qnerf.experiment import build_field
from qnerf.visibility import SpaceMask


@pytest.fixture
def field():
    torch.manual_seed(0)
    return build_field(
        settings_from(composed("field=qboth", "encoder=none", "appearance=2", "hash=C7")), views=4
    ).eval()


@pytest.fixture
def points():
    return torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(1))


DIRECTIONS = torch.nn.functional.normalize(torch.arange(15.0).view(5, 3) - 6, dim=-1)


def test_shapes_and_ranges(field, points):
    density, color = field(points, DIRECTIONS, torch.arange(5) % 4)
    assert density.shape == (5, 7)
    assert color.shape == (5, 7, 3)
    assert (density >= 0).all()
    assert ((color > 0) & (color < 1)).all()
    torch.testing.assert_close(field.density(points), density)


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


def test_a_view_without_an_embedding_gets_the_mean_of_all(field, points):
    none = torch.full((5,), -1)
    _, unknown = field(points, DIRECTIONS, none)
    with torch.no_grad():
        field.appearance.weight[:] = field.appearance.weight.mean(0)
    _, mean = field(points, DIRECTIONS, torch.arange(5) % 4)
    torch.testing.assert_close(unknown, mean)


def test_the_mask_empties_space_and_stops_its_gradient(field, points):
    grid = torch.zeros(2, 2, 2, dtype=torch.bool)
    grid[1] = True
    field.mask = SpaceMask(grid)
    density = field.density(points)
    assert torch.equal(density > 0, points[..., 0] > 0)


def test_initial_scales_the_density(points):
    fields = []
    for initial in (1.0, 0.1):
        torch.manual_seed(0)
        fields.append(
            build_field(settings_from(composed("encoder=none", f"density.initial={initial}")), views=1).eval()
        )
    torch.testing.assert_close(0.1 * fields[0].density(points), fields[1].density(points))
