"""The built-in scene: determinism, exact depth, cache, options."""

import importlib.metadata
from pathlib import Path

import numpy as np
import pytest
import torch

from qnerf.config.cache import cache_folder
from qnerf.geometry.rays import RayTable
from qnerf.scenes import SCENES, Scene
from qnerf.scenes.builtin import poster
from qnerf.scenes.builtin.atlas import Atlas
from qnerf.scenes.builtin.light import Panel, bake
from qnerf.scenes.builtin.room import room, walk
from qnerf.scenes.builtin.textures import encoded, linear
from qnerf.scenes.builtin.tracer import Ball, Box, World

SMALL = {"views": 12, "width": 18, "height": 32, "supersample": 2}


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("QNERF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("QNERF_CACHE", str(tmp_path_factory.mktemp("poster")))
        return SCENES.build("poster", **SMALL)


def equal(a: Scene, b: Scene) -> bool:
    assert a.depth is not None
    assert b.depth is not None
    same = torch.equal(a.images, b.images) and torch.equal(a.depth, b.depth)
    return same and torch.equal(a.cameras.poses, b.cameras.poses) and a.fingerprint == b.fingerprint


def test_shapes_and_split(scene):
    assert scene.images.shape == (12, 32, 18, 3)
    assert scene.images.dtype == torch.uint8
    assert scene.depth.shape == (12, 32, 18)
    assert scene.depth.dtype == torch.float32
    assert scene.cameras.poses.shape == (12, 3, 4)
    assert (len(scene.train), len(scene.eval)) == (11, 1)
    assert sorted(scene.names) == scene.names == [f"{view:02d}" for view in range(12)]
    assert float(scene.cameras.poses[:, :, 3].abs().max()) == pytest.approx(1)


def test_points_at_the_depth_lie_on_surfaces(scene):
    scale = float(torch.linalg.det(scene.transform[:3, :3]) ** (1 / 3))
    table = RayTable(scene, dtype=torch.float64)
    back = torch.linalg.inv(scene.transform)
    for view in range(len(scene.images)):
        points = table.view(view).along(scene.depth[view].reshape(-1, 1).double())[:, 0]
        metres = points @ back[:3, :3].T + back[:3, 3]
        assert np.abs(room().clearance(metres.T.numpy())).max() < 1e-5 / scale


def test_the_same_bits_every_time_however_the_work_is_shared(scene, monkeypatch, tmp_path):
    monkeypatch.setattr(poster.os, "cpu_count", lambda: 1)
    monkeypatch.setattr(poster, "CHUNK", 300)
    assert equal(scene, SCENES.build("poster", **SMALL))


def test_the_cache_is_used_and_rebuilt_when_damaged(scene, cache, monkeypatch):
    first = SCENES.build("poster", **SMALL)
    files = list(cache.iterdir())
    assert len(files) == 1
    assert files[0].suffix == ".npz"
    whole = files[0].read_bytes()

    def never(**options):
        raise AssertionError("the cache was not used")

    with monkeypatch.context() as patch:
        patch.setattr(poster, "render_views", never)
        assert equal(first, SCENES.build("poster", **SMALL))
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :]
    for damaged in (b"", b"nonsense", whole[:-100], whole[:1000], flipped):
        files[0].write_bytes(damaged)
        assert equal(scene, SCENES.build("poster", **SMALL))
        assert files[0].read_bytes() == whole
    assert list(cache.iterdir()) == files


def test_a_cache_that_cannot_be_written_is_no_error(scene, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("QNERF_CACHE", str(tmp_path / "file" / "cache"))
    assert equal(scene, SCENES.build("poster", **SMALL))

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setenv("QNERF_CACHE", str(tmp_path / "full"))
    monkeypatch.setattr(poster.os, "replace", full)
    assert equal(scene, SCENES.build("poster", **SMALL))
    assert list((tmp_path / "full").iterdir()) == []


def test_where_the_cache_lies(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "cache"
    monkeypatch.delenv("QNERF_CACHE")
    assert cache_folder() == tmp_path / "xdg" / "qnerf"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "qnerf"


def test_options_change_the_scene_and_its_fingerprint(scene):
    assert SCENES.build("poster", **SMALL | {"width": 37, "height": 65}, downscale=2).images.shape == (12, 32, 18, 3)
    other = SCENES.build("poster", **SMALL, seed=1)
    assert other.fingerprint != scene.fingerprint
    assert not torch.equal(other.cameras.poses, scene.cameras.poses)
    smooth = SCENES.build("poster", **SMALL | {"supersample": 3})
    assert smooth.fingerprint != scene.fingerprint
    assert torch.equal(smooth.depth, scene.depth)
    assert 0 < float((smooth.images.float() - scene.images.float()).abs().mean()) < 8


def test_bad_options():
    for options, message in (
        ({"views": 2}, "views must be between 3 and"),
        ({"width": 0}, "width must be between 1 and"),
        ({"supersample": 0}, "supersample must be between 1 and"),
        ({"downscale": 0}, "downscale must be between 1 and"),
        ({"downscale": 40}, "downscale=40 is larger than the images, 36 x 64"),
        ({"seed": -1}, "seed must be between 0 and"),
        ({"path": "somewhere"}, "built in and has no path, got 'somewhere'; for images use scene=nerfstudio"),
        ({"views": 2.5}, "views expects int"),
        ({"colour": 1}, "unknown option colour=1; known: path"),
    ):
        with pytest.raises(ValueError, match=message):
            SCENES.build("poster", **options)


@pytest.mark.parametrize("seed", range(5))
def test_the_walk_stays_in_the_room_clear_of_things_and_looks_at_the_poster(seed):
    poses = walk(226, seed)
    assert room().clearance(poses[:, :, 3].T).min() > 0.3
    rotation = poses[:, :, :3]
    np.testing.assert_allclose(
        rotation.transpose(0, 2, 1) @ rotation, np.broadcast_to(np.eye(3), (226, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    towards = np.array([1.4, 0, 1.2]) - poses[:, :, 3]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert (-(rotation[:, :, 2] * towards).sum(1)).min() > np.cos(np.radians(40))
    steps = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    assert steps.max() < 0.2
    distances = np.linalg.norm(poses[:, :, 3] - [1.4, 0, 1.2], axis=1)
    assert distances.max() > 1.5 * distances.min()


def test_the_photographs_lie_inside_the_package():
    shipped = {str(file) for file in importlib.metadata.files("scikit-image") or []}
    assert {f"skimage/data/{name}.png" for name in ("astronaut", "chelsea", "coffee")} <= shipped


def empty_room(extra=(), balls=()) -> World:
    atlas = Atlas()
    white = atlas.add(np.full((4, 4, 3), 0.5, np.float32))
    boxes = [Box((-1, -1, -1), (1, 1, 1), [white] * 6, room=True)]
    boxes += [Box(low, high, [white] * 6, yaw=yaw) for low, high, yaw in extra]
    return World(boxes, [Ball(centre, radius, white, 0.5) for centre, radius in balls], atlas)


def test_rays_meet_boxes_and_balls_where_marching_does():
    world = empty_room([((-0.5, -0.3, -1), (-0.1, 0.2, -0.2), 0.5)], [((0.4, 0.3, -0.4), 0.3)])
    random = np.random.default_rng(0)
    origin = np.array([[0.1], [-0.6], [0.5]])
    direction = random.normal(size=(3, 3000))
    direction /= np.linalg.norm(direction, axis=0)
    hits = world.trace(origin, direction)
    marched = np.zeros(3000)
    for _ in range(300):
        marched += np.maximum(world.clearance(origin + direction * marched), 0)
    np.testing.assert_allclose(hits.distance, marched, atol=2e-4)
    assert {0, 1, 2} <= set(np.minimum(hits.surface // 6, 2).tolist())
    assert ((hits.normal * direction).sum(0) < 0).all()
    # a surface's own coordinates lead back to the point, with the same normal
    point, normal = world.surface_points(hits.surface, hits.u, hits.v)
    np.testing.assert_allclose(point, origin + direction * hits.distance, atol=1e-9)
    np.testing.assert_allclose(normal, hits.normal, atol=1e-9)


def test_a_small_light_falls_off_as_it_should():
    """E / pi = L A cos cos' / (pi r^2) straight below a small panel, with nothing bounced; nothing in the shadow."""
    panel = Panel((-0.01, -0.01, 0.99), ((0.02, 0, 0), (0, 0.02, 0)), (0, 0, -1), np.full(3, 100.0), side=2)
    world = empty_room()
    bake(world, [panel], rays=1, bounces=0)
    floor, middle = np.array([5], np.int32), np.array([0.5])
    received = world.baked(floor, middle, middle)[0, 0]
    assert received == pytest.approx(100 * 4e-4 / (np.pi * 1.99**2), rel=0.01)
    shaded = empty_room([((-0.2, -0.2, 0), (0.2, 0.2, 0.1), 0.0)])
    bake(shaded, [panel], rays=1, bounces=0)
    assert shaded.baked(floor, middle, middle)[0, 0] == 0
    assert shaded.baked(floor, np.array([0.05]), middle)[0, 0] > 0


def test_srgb_goes_both_ways():
    values = np.linspace(0, 1, 256)
    np.testing.assert_allclose(encoded(linear(values)), values, atol=1e-6)
