import pytest
import torch

from qnerf.geometry.contraction import CONTRACTIONS
from qnerf.geometry.visibility import CHUNK, VIEWS, SpaceMask, count_views, visible_cells
from qnerf.scenes import SCENES
from tests.helpers.scenes import write_scene


@pytest.fixture
def scene(tmp_path):
    return SCENES.build("nerfstudio", path=str(write_scene(tmp_path / "ring", views=8, width=16, height=12)))


@pytest.mark.parametrize("name", CONTRACTIONS.names())
def test_density_stays_where_enough_cameras_see(scene, name):
    contraction = CONTRACTIONS.build(name)
    mask = SpaceMask(visible_cells(contraction, scene.cameras, scene.train, 3, 48))
    centre = torch.zeros(1, 1, 3)
    behind = scene.cameras.poses[0, :, 2].float() * 3  # behind the first camera, which looks at the centre
    assert mask(contraction(centre)).item() == 1
    if name != "box":
        assert mask(contraction(behind[None])).item() == 0
    assert 0 < mask.grid.double().mean() < 1
    assert mask(torch.tensor([[float("inf"), 0, 0]])).shape == (1,)


def test_visibility_of_more_cameras_leaves_less_space(scene):
    contraction = CONTRACTIONS.build("linf")
    grids = [visible_cells(contraction, scene.cameras, scene.train, least, 24) for least in (1, 2, 3)]
    fractions = [grid.double().mean() for grid in grids]
    assert fractions == sorted(fractions, reverse=True)
    assert fractions[0] > fractions[-1]


def test_few_views_are_asked_for_half_of_them(scene):
    contraction = CONTRACTIONS.build("linf")
    asked = [visible_cells(contraction, scene.cameras, scene.train[:4], least, 24) for least in (2, 50)]
    assert torch.equal(*asked)


def test_visibility_of_nothing_is_one_line(scene):
    away = scene.cameras.poses.clone()
    away[:, :, :3] = -away[:, :, :3]  # no rotation, but every camera looks outward
    away[:, :, 3] *= 1e6
    cameras = type(scene.cameras)(**{**vars(scene.cameras), "poses": away})
    with pytest.raises(ValueError, match="no cell is seen by") as caught:
        visible_cells(CONTRACTIONS.build("box"), cameras, scene.train, 8, 8)
    assert "\n" not in str(caught.value)


def test_borders_belong_to_the_image_and_what_lies_behind_does_not():
    camera = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]]).double()  # pixel = (x, y) / z
    points = torch.tensor([[0, 0, 1], [4, 6, 2], [-1, 0, 1], [3, 1, 1], [1, 4, 1], [-1, -1, -1], [0, 0, 0]]).double()
    assert count_views(points, camera, 2, 3, 1).tolist() == [1, 1, 0, 0, 0, 0, 0]  # in an image of 2 x 3


def test_counting_goes_on_until_every_point_of_a_part_has_enough():
    whole = torch.Generator().manual_seed(0)  # whole numbers: exact however sums are ordered
    points = torch.randint(-9, 10, (CHUNK + 7, 3), generator=whole).double()
    matrices = torch.randint(-9, 10, (2 * VIEWS + 3, 3, 4), generator=whole).double()
    seen = torch.zeros(len(points), dtype=torch.int64)
    for matrix in matrices:
        x, y, depth = (points @ matrix[:, :3].T + matrix[:, 3]).T
        seen += (depth > 0) & (x >= 0) & (x <= 4 * depth) & (y >= 0) & (y <= 3 * depth)
    assert seen.unique().tolist() == list(range(int(seen.max()) + 1))
    for limit in (1, 3, 99):
        assert torch.equal(count_views(points, matrices, 4, 3, limit).clamp(max=limit), seen.clamp(max=limit))
