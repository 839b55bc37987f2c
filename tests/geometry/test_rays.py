"""Pixels -> rays: axes, lens, poses, and the table that training draws from."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from qnerf.geometry import rays
from qnerf.geometry.bounds import bounds_of, described_bounds, misfit
from qnerf.geometry.pose_refinement import CAMERAS
from qnerf.geometry.rays import RayTable, camera_directions, camera_rays, project
from qnerf.scenes import Cameras
from qnerf.scenes.lens import _distort, distort
from tests.helpers import worlds

IDENTITY = torch.eye(4, dtype=torch.float64)[:3]
FOX = torch.tensor([0.0578421, -0.0805099, -0.000980296, 0.00015575], dtype=torch.float64)


def cameras(views=5, width=7, height=9, per_view=False):
    change = torch.rand(views, generator=torch.Generator().manual_seed(views), dtype=torch.float64) * per_view
    return dataclasses.replace(
        worlds.cameras(worlds.ring(views, radius=3.0), width, height),
        fx=8 + change,
        fy=8.5 + change,
        cx=3.4 + change,
        cy=4.6 - change,
        distortion=FOX.expand(views, 4),
    )


def scene(cams, channels=3, **options):
    size = len(cams), cams.height, cams.width, channels
    images = torch.randint(0, 256, size, generator=torch.Generator().manual_seed(1)).to(torch.uint8)
    return worlds.scene(images, cams, **options)


def test_axes_are_those_of_opengl():
    cams = Cameras(
        IDENTITY[None],
        *(torch.tensor([value], dtype=torch.float64) for value in (10.0, 20.0, 4.0, 3.0)),
        torch.zeros(1, 4, dtype=torch.float64),
        8,
        6,
    )
    views = torch.zeros(3, dtype=torch.int64)
    found = camera_directions(cams, views, torch.tensor([[4.0, 3.0], [14.0, 3.0], [4.0, 23.0]]))
    half = math.sqrt(0.5)
    expected = torch.tensor([[0, 0, -1], [half, 0, -half], [0, -half, -half]], dtype=torch.float64)
    torch.testing.assert_close(found, expected)
    rays = camera_rays(cams, views, torch.tensor([[4.0, 3.0]]).expand(3, 2), 0.1, 7.0)
    assert rays.origins.dtype == torch.float32
    assert rays.near.shape == rays.far.shape == (3, 1)
    assert (float(rays.near[0]), float(rays.far[2])) == pytest.approx((0.1, 7.0))


coefficients = st.tuples(st.floats(-0.15, 0.3), st.floats(-0.02, 0.1), st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
points = st.lists(st.tuples(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9)), min_size=1, max_size=8)


@given(points, coefficients)
def test_the_jacobian_of_the_lens_is_that_of_autograd(ideal, lens):
    lens = torch.tensor(lens, dtype=torch.float64)
    for point in torch.tensor(ideal, dtype=torch.float64):
        expected = torch.autograd.functional.jacobian(lambda p, lens=lens: distort(p, lens), point)
        _, xx, xy, yy = _distort(point, lens)
        torch.testing.assert_close(torch.stack([xx, xy, xy, yy]).view(2, 2), expected, atol=1e-12, rtol=1e-12)


@given(st.integers(0, 4), st.floats(0, 7), st.floats(0, 9), st.floats(0.1, 50), st.booleans())
def test_points_on_a_ray_project_to_its_pixel(view, x, y, distance, per_view):
    cams = cameras(per_view=per_view)
    pixel, views = torch.tensor([[x, y]], dtype=torch.float64), torch.tensor([view])
    rays = camera_rays(cams, views, pixel, 0.05, 10.0, dtype=torch.float64)
    seen, depth = project(cams, views, rays.along(torch.tensor([[distance]], dtype=torch.float64))[:, 0])
    torch.testing.assert_close(seen, pixel, atol=1e-8, rtol=0)
    assert 0 < float(depth) <= distance * (1 + 1e-12)
    torch.testing.assert_close(torch.linalg.vector_norm(rays.directions, dim=1), torch.ones(1, dtype=torch.float64))


def test_a_view_is_row_by_row_through_pixel_centres():
    cams = cameras()
    rays = RayTable(scene(cams), dtype=torch.float64).view(3)
    assert len(rays) == 63
    seen, _ = project(cams, rays.cameras, rays.along(torch.ones(63, 1, dtype=torch.float64))[:, 0])
    y, x = torch.meshgrid(torch.arange(9), torch.arange(7), indexing="ij")
    torch.testing.assert_close(seen, torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5, check_dtype=False)
    assert torch.equal(rays.cameras, torch.full((63,), 3))
    torch.testing.assert_close(rays.origins, cams.poses[3, :, 3].expand(63, 3))


@pytest.mark.parametrize("channels", [3, 4])
def test_a_batch_holds_the_colours_of_the_pixels_its_rays_go_through(channels):
    cams = cameras(per_view=True)
    world = scene(cams, channels, train=[0, 2, 4], eval=[1, 3])
    table = RayTable(world, dtype=torch.float64)
    rays, colors = table.batch(table.draw(500, torch.Generator().manual_seed(3)))
    pixels, _ = project(cams, rays.cameras, rays.along(torch.ones(500, 1, dtype=torch.float64))[:, 0])
    x, y = pixels.floor().long().unbind(-1)
    assert colors.shape == (500, channels)
    torch.testing.assert_close(colors, world.images[rays.cameras, y, x].double() / 255)
    assert set(rays.cameras.tolist()) == {0, 2, 4}


@given(
    stride=st.integers(2, 40),
    width=st.integers(1, 7),
    height=st.integers(1, 6),
    train=st.lists(st.integers(0, 4), min_size=1, max_size=5, unique=True),
)
@settings(max_examples=60)
def test_pixels_kept_apart_are_never_drawn_and_all_others_are(stride, width, height, train):
    """All draws there are: `randint` is replaced by counting."""
    total = len(train) * width * height
    world = scene(cameras(width=width, height=height), train=train, eval=[])
    if stride > total:
        with pytest.raises(ValueError, match=r"stop\.share holds out one training pixel in \d+, which is none here"):
            RayTable(world, validation_stride=stride)
        return
    table = RayTable(world, validation_stride=stride)
    table.batch = lambda numbers, _: numbers
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "randint", lambda high, size, generator: torch.arange(high))
        training = table.draw(total, torch.Generator())
    validation = table.validation(total)
    assert len(validation) == total // stride
    assert torch.equal(torch.cat([training, validation]).sort().values, torch.arange(total))


def test_validation_is_at_most_so_many_pixels_evenly_spread_and_the_same_each_time():
    world = scene(cameras(), channels=4)
    table = RayTable(world, validation_stride=5)
    rays, colors = table.validation(10)
    assert len(rays) == len(colors) == 10
    assert colors.shape == (10, 4)
    assert set(rays.cameras.tolist()) == {0, 1, 2, 3}
    assert torch.equal(table.validation(10)[0].directions, rays.directions)
    assert len(table.validation(10_000)[0]) == 4 * 63 // 5


@pytest.mark.parametrize("per_view", [False, True])
def test_the_table_and_the_lens_agree(monkeypatch, per_view):
    world = scene(cameras(per_view=per_view))
    kept = RayTable(world, dtype=torch.float64)
    monkeypatch.setattr(rays, "MAX_TABLE_SIZE", 0)
    computed = RayTable(world, dtype=torch.float64)
    assert kept.directions is not None
    assert computed.directions is None
    for a, b in (
        (kept.view(2), computed.view(2)),
        tuple(table.batch(table.draw(50, torch.Generator().manual_seed(1)))[0] for table in (kept, computed)),
    ):
        torch.testing.assert_close(a.directions, b.directions, rtol=0, atol=1e-14)
        assert torch.equal(a.cameras, b.cameras)


@pytest.mark.parametrize("name", ["so3xr3", "se3"])
def test_poses_are_refined_and_differentiated_through_the_rays(name):
    world = scene(cameras())
    table = RayTable(world, dtype=torch.float64)
    refinement = CAMERAS.build(name, 5, world.train).double()
    plain, _ = table.batch(table.draw(40, torch.Generator().manual_seed(0)))
    rays, _ = table.batch(table.draw(40, torch.Generator().manual_seed(0)), refinement)
    torch.testing.assert_close(rays.directions, plain.directions)
    torch.testing.assert_close(rays.origins, plain.origins)
    (rays.directions.square() @ torch.tensor([1.0, 2, 3]).double() + rays.origins.sum(-1)).sum().backward()
    assert bool((refinement.motion.grad != 0).any(0).all())

    with torch.no_grad():
        refinement.motion.normal_(0, 0.1, generator=torch.Generator().manual_seed(0))
    moved, _ = table.batch(table.draw(40, torch.Generator().manual_seed(0)), refinement)
    assert not torch.allclose(moved.directions, plain.directions, atol=1e-3)
    torch.testing.assert_close(torch.linalg.vector_norm(moved.directions, dim=1), torch.ones(40, dtype=torch.float64))
    held_out = table.view(4, refinement)
    torch.testing.assert_close(held_out.directions, table.view(4).directions)


@pytest.mark.parametrize(
    ("own", "asked", "act"),
    [
        ((None, None), (None, None), (0.05, 1000.0)),
        ((1.0, 6.0), (None, None), (1.0, 6.0)),
        ((1.0, 6.0), (0.05, None), (0.05, 6.0)),
        ((1.0, 6.0), (None, 1000.0), (1.0, 1000.0)),
        ((None, None), (0.25, 8.0), (0.25, 8.0)),
    ],
)
def test_bounds_are_the_user_s_else_the_scene_s(own, asked, act):
    table = RayTable(scene(cameras(), near=own[0], far=own[1]), near=asked[0], far=asked[1])
    rays = table.view(0)
    assert (float(rays.near[0]), float(rays.far[0])) == pytest.approx(act)


@pytest.mark.parametrize(("radius", "factor"), [(4.0, None), (12.0, 3.0), (2.0, 0.5), (1.0, 0.25), (6.0, 1.5)])
def test_bounds_follow_the_scale_of_the_cameras(radius, factor):
    """As synthetic NeRF's: near 2 and far 6 belong to cameras that are 4 away from what they look at."""
    of = worlds.cameras(worlds.ring(8, radius=radius, height=0.0), focal=40.0)
    world = worlds.scene(torch.zeros(8, 24, 32, 3, dtype=torch.uint8), of, near=2.0, far=6.0)
    assert misfit(world) == (factor and pytest.approx(factor))
    near, far = bounds_of(world, None, None)
    assert (near, far) == pytest.approx((2 * (factor or 1), 6 * (factor or 1)))
    assert ("do not fit the cameras" in described_bounds(world, near, far)) == (factor is not None)
    assert bounds_of(world, 0.5, None) == pytest.approx((0.5, 6 * (factor or 1)))
    outward = worlds.cameras(worlds.ring(8, radius=radius, height=0.0, outward=True))
    assert misfit(dataclasses.replace(world, cameras=outward)) is None


def test_bounds_in_the_wrong_order_are_refused():
    for near, far in ((-1, 2), (2, 2), (math.nan, 2), (1, math.nan)):
        with pytest.raises(ValueError, match="near must be at least 0 and below far"):
            RayTable(scene(cameras()), near=near, far=far)


def test_rays_computed_in_parts_are_the_same(monkeypatch):
    scene = worlds.ball(views=4, size=32)
    whole = rays.RayTable(scene, validation_stride=7)
    monkeypatch.setattr(rays, "PART", 96)
    parts = rays.RayTable(scene, validation_stride=7)
    assert torch.equal(whole.directions, parts.directions)
    numbers = torch.arange(6, 3 * 32 * 32, 7)  # the held-out pixels, one by one
    chosen = numbers[torch.linspace(0, len(numbers) - 1, 50, dtype=torch.float64).long()]
    held_out, colors = parts.validation(50)
    views, pixels = torch.div(chosen, 32 * 32, rounding_mode="floor"), chosen % (32 * 32)
    assert torch.equal(held_out.directions, parts.rays(views, pixels).directions)
    assert torch.equal(colors, parts.colors[chosen].float() / 255)
