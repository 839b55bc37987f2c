"""Images of differing size, masks, fisheyes, and images reduced to any width."""

import json
import shutil
from functools import partial

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from qnerf.building.scene import prepare
from qnerf.geometry.hull import sees_through
from qnerf.geometry.rays import RayTable, camera_directions, camera_rays, project
from qnerf.geometry.visibility import count_cameras
from qnerf.scenes.area import area_resize
from tests.helpers import scenes
from tests.helpers.configs import composed
from tests.helpers.scenes import change, change_frame, write_scene

SIZES = [(8, 6), (6, 8), (8, 6), (12, 9), (8, 6), (6, 8)]
BLACK = 2  # columns of each mask


build = partial(scenes.build, "nerfstudio")


@pytest.fixture
def mixed(tmp_path):
    """Six views of three sizes, each with its own intrinsics."""
    folder = write_scene(tmp_path / "scene")
    random = np.random.default_rng(0)

    def own(content):
        for frame, (width, height) in zip(content["frames"], SIZES, strict=True):
            pixels = random.integers(0, 255, (height, width, 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / frame["file_path"])
            frame.update(w=width, h=height, cx=width / 2, cy=height / 2, fl_x=float(width), fl_y=float(width))

    change(folder, own)
    return folder


def mask(folder, views=range(6)):
    """Adds masks whose left columns are black."""
    (folder / "masks").mkdir()

    def add(content):
        for view in views:
            frame = content["frames"][view]
            with Image.open(folder / frame["file_path"]) as image:
                width, height = image.size
            values = np.full((height, width), 255, np.uint8)
            values[:, :BLACK] = 0
            Image.fromarray(values).save(folder / "masks" / f"{view}.png")
            frame["mask_path"] = f"masks/{view}.png"

    change(folder, add)


def test_each_view_keeps_its_size_its_rays_and_its_colours(mixed):
    scene = build(mixed)
    table = RayTable(scene, dtype=torch.float64)
    for view, (width, height) in enumerate(SIZES):
        truth = np.asarray(Image.open(mixed / scene.names[view]))
        np.testing.assert_array_equal(scene.image(view), truth)
        assert table.view(view).directions.shape == (width * height, 3)
    rays, colors = table.batch(table.draw(500, torch.Generator().manual_seed(0)))
    assert set(rays.cameras.tolist()) == set(scene.train)
    for view in scene.train:
        of_view = rays.cameras == view
        pixels, depth = project(scene.cameras, rays.cameras[of_view], (rays.origins + rays.directions)[of_view])
        x, y = (pixels - 0.5).round().long().T
        assert bool((depth > 0).all())
        assert torch.equal(colors[of_view], scene.image(view)[y, x].double() / 255)
    # without the table of directions, too
    again = RayTable.rays(table, torch.tensor([1, 3]), torch.tensor([7, 100]))
    table.table = None
    torch.testing.assert_close(table.rays(torch.tensor([1, 3]), torch.tensor([7, 100])).directions, again.directions)


def test_pixels_are_drawn_evenly_over_views_of_differing_size(mixed):
    table = RayTable(build(mixed))
    views, pixels = table.training.locate(torch.arange(len(table.training)))
    counted = {view: int((views == view).sum()) for view in views.unique().tolist()}
    assert counted == {view: SIZES[view][0] * SIZES[view][1] for view in table.training.views.tolist()}
    assert len(set(zip(views.tolist(), pixels.tolist(), strict=True))) == len(views)


def test_a_point_is_seen_inside_each_view_s_own_image(mixed):
    cameras = build(mixed).cameras
    points = torch.randn(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    expected = torch.zeros(300, dtype=torch.int64)
    for view, (width, height) in enumerate(SIZES):
        pixels, depth = project(cameras, torch.full((300,), view), points)
        x, y = pixels.T
        expected += (depth > 0) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
    assert len(expected.unique()) > 3
    assert torch.equal(count_cameras(points, cameras, list(range(6))), expected)


def test_masked_pixels_are_not_trained_on_and_a_mask_decides_the_fingerprint(mixed):
    before = build(mixed)
    mask(mixed, range(5))
    scene = build(mixed)
    table = RayTable(scene)
    views, pixels = table.training.locate(torch.arange(len(table.training)))
    widths = scene.cameras.all_sizes[views, 0]
    assert int((pixels % widths)[views < 5].min()) == BLACK
    assert int(pixels[views == 5].min()) == 0  # it has no mask
    assert len(table.training) == sum(SIZES[view][1] * (SIZES[view][0] - BLACK * (view < 5)) for view in scene.train)
    seen = {before.fingerprint, scene.fingerprint}
    Image.new("L", SIZES[0], 255).save(mixed / "masks" / "0.png")
    seen.add(build(mixed).fingerprint)
    assert len(seen) == 3


def test_a_reduced_pixel_counts_if_no_black_pixel_is_in_it(tmp_path):
    folder = write_scene(tmp_path / "scene")
    mask(folder)
    for width, columns in ((4, 1), (5, 2)):
        reduced = build(folder, width=width).mask
        assert reduced is not None
        assert bool((~reduced[..., :columns]).all())
        assert bool(reduced[..., columns:].all())


def test_masks_are_found_where_other_tools_put_them(tmp_path):
    """Each place once: another key, instant-ngp's file beside the image, a folder of masks, a larger mask."""
    folder = write_scene(tmp_path / "scene")
    mask(folder)
    expected = build(folder)
    assert expected.mask is not None
    assert expected.masks == 6
    for key in ("mask_filename", "mask_file_path"):
        place = shutil.copytree(folder, tmp_path / key)
        change(place, lambda t, key=key: [frame.update({key: frame.pop("mask_path")}) for frame in t["frames"]])
        assert torch.equal(build(place).mask, expected.mask)
    place = shutil.copytree(folder, tmp_path / "whole")
    change(place, lambda t: (t.update(mask_path="masks/0.png"), [frame.pop("mask_path") for frame in t["frames"]]))
    assert torch.equal(build(place).mask, expected.mask)
    change(folder, lambda t: [frame.pop("mask_path") for frame in t["frames"]])
    folders = {"a.png": "{:03d}.png", "a.png.png": "{:03d}.png.png", "images": "images/{:03d}.png"}
    for number, name in enumerate(folders.values()):
        place = shutil.copytree(folder, tmp_path / f"folder {number}")
        for view in range(6):
            file = place / "masks" / name.format(view)
            file.parent.mkdir(exist_ok=True)
            with Image.open(place / "masks" / f"{view}.png") as small:
                small.resize((16, 12), Image.Resampling.NEAREST).save(file)
        scene = build(place)
        assert torch.equal(scene.mask, expected.mask)
        assert scene.fingerprint != expected.fingerprint
    for view in range(6):
        values = 255 - np.asarray(Image.open(folder / "masks" / f"{view}.png"))
        Image.fromarray(values).save(folder / "images" / f"dynamic_mask_{view:03d}.png")
    shutil.rmtree(folder / "masks")
    scene = build(folder)
    assert torch.equal(scene.mask, expected.mask)
    assert scene.description() == "6 views of 8 x 6 pixels, 5 train, 1 held out, 6 masks (25.0% of the pixels)"


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "cut out"])
def test_the_alpha_of_a_mask_is_the_mask_where_it_is_transparent(tmp_path, mode, inverted):
    folder = write_scene(tmp_path / "scene")
    mask(folder)
    expected = build(folder)
    for view in range(6):
        place = folder / "masks" / f"{view}.png"
        values = np.asarray(Image.open(place))
        alpha = 255 - values if inverted else values
        color = (
            Image.open(folder / "images" / f"{view:03d}.png")
            if mode == "cut out"
            else Image.new("RGB", (8, 6), "white")
        )
        color.putalpha(Image.fromarray(alpha))
        if mode == "P":
            color = Image.fromarray((alpha // 255).copy(), "P")
            color.putpalette([255] * 6)
            color.info["transparency"] = bytes([0, 255])
        elif mode == "LA":
            color = color.convert("LA")
        color.save(folder / "images" / f"dynamic_mask_{view:03d}.png" if inverted else place)
    if inverted:
        shutil.rmtree(folder / "masks")
        change(folder, lambda t: [frame.pop("mask_path") for frame in t["frames"]])
    scene = build(folder)
    assert expected.mask is not None
    assert torch.equal(scene.mask, expected.mask)
    assert "6 masks (25.0% of the pixels)" in scene.description()


def test_pixels_beyond_a_crop_radius_do_not_count(tmp_path):
    folder = write_scene(tmp_path / "scene", width=16, height=12)
    plain = build(folder)
    change(folder, lambda t: t.update(fisheye_crop_radius=5.0))
    scene = build(folder)
    y, x = np.mgrid[:12, :16]
    np.testing.assert_array_equal(scene.mask[3], np.hypot(x - 7.5, y - 5.5) <= 5)
    assert "0 masks (58.3% of the pixels)" in scene.description()
    assert scene.fingerprint != plain.fingerprint
    whole = {"w": 32, "h": 24, "fl_x": 16.0, "fl_y": 16.0, "cx": 16.0, "cy": 12.0, "fisheye_crop_radius": 10.0}
    change(folder, lambda t: t.update(whole))
    assert torch.equal(build(folder).mask, scene.mask)
    assert int(build(folder, width=8).mask.sum()) == 6 * 4 * 4
    change(folder, lambda t: t.update(fisheye_crop_radius=0))
    scenes.refused("nerfstudio", folder, "fisheye_crop_radius must be above 0 pixels, got 0")


def test_held_out_views_that_are_all_masked_are_refused(tmp_path):
    folder = write_scene(tmp_path / "scene")
    mask(folder)
    [held_out] = build(folder).eval
    Image.new("L", (8, 6)).save(folder / "masks" / f"{held_out}.png")
    with pytest.raises(ValueError, match="no pixel to measure: all held-out views are masked"):
        prepare(composed("scene=nerfstudio", f"scene.path={folder}"))


def test_masks_that_do_not_fit_are_one_line(tmp_path):
    folder = write_scene(tmp_path / "scene")
    mask(folder)
    for size in ((4, 4), (16, 16), (12, 6)):
        Image.new("L", size).save(folder / "masks" / "2.png")
        told = f"mask 'masks/2.png' has {size[0]} x {size[1]} pixels; expected the 8 x 6 of its image 'images/002.png'"
        scenes.refused("nerfstudio", folder, told)
    (folder / "masks" / "2.png").unlink()
    scenes.refused("nerfstudio", folder, "frame 'images/002.png': mask 'masks/2.png' does not exist")
    for view in range(6):
        Image.new("L", (8, 6)).save(folder / "masks" / f"{view}.png")
    with pytest.raises(ValueError, match="the masks leave no pixel to train on"):
        RayTable(build(folder))
    with pytest.raises(ValueError, match="the masks leave no pixel to train on"):
        prepare(composed("needs=auto", "scene=nerfstudio", f"scene.path={folder}"))


def test_silhouettes_say_nothing_behind_a_mask(tmp_path):
    folder = write_scene(tmp_path / "scene", channels=4)
    for file in (folder / "images").iterdir():
        Image.new("RGBA", (8, 6), (0, 0, 0, 0)).save(file)
    pose = build(folder).cameras.poses[0]
    point, radius = (pose[:, 3] - pose[:, 2])[None], torch.tensor([1e-6])  # in the middle of the image
    assert bool(sees_through(build(folder), 0, point, radius))
    (folder / "masks").mkdir()
    Image.new("L", (8, 6), 0).save(folder / "masks" / "0.png")
    change_frame(folder, 0, mask_path="masks/0.png")
    assert not bool(sees_through(build(folder), 0, point, radius))


# --- width


def test_scene_width_keeps_what_is_seen(tmp_path):
    folder = write_scene(tmp_path / "scene", width=11, height=7)
    full, small = build(folder), build(folder, width=5)
    assert small.images.shape == (6, 3, 5, 3)
    # corners of the image stay corners
    for point in ((0.0, 0.0), (1.0, 1.0)):
        rays = [
            camera_directions(of, torch.tensor([2]), torch.tensor([[point[0] * of.width, point[1] * of.height]]))
            for of in (full.cameras, small.cameras)
        ]
        torch.testing.assert_close(rays[0], rays[1])
    # by definition: each pixel is cut into 5 x 3 parts, and 11 x 7 parts are averaged
    image = full.images[0].double().repeat_interleave(5, 1).repeat_interleave(3, 0)
    means = image.reshape(3, 7, 5, 11, 3).mean(dim=(1, 3))
    assert float((small.images[0] - means).abs().max()) <= 0.5 + 1e-4


def test_transparent_pixels_do_not_colour_their_neighbours():
    image = np.zeros((1, 3, 4), np.uint8)
    image[0, :, :] = [(200, 0, 0, 255), (0, 200, 0, 0), (0, 0, 200, 255)]
    assert area_resize(image, 2, 1).tolist() == [[[200, 0, 0, 170], [0, 0, 200, 170]]]


def test_wider_images_are_reduced_and_the_others_stay(mixed):
    scene = build(mixed, width=7)
    assert [scene.cameras.size(view) for view in range(6)] == [(7, 5), (6, 8), (7, 5), (7, 5), (7, 5), (6, 8)]
    with pytest.raises(ValueError, match="width=13 is more than the images have, 12 pixels"):
        build(mixed, width=13)


# --- smaller images than the file says


def test_a_file_of_the_full_size_goes_with_smaller_images(tmp_path):
    small = write_scene(tmp_path / "small")
    expected = build(small)
    full = {"w": 32, "h": 24, "fl_x": 32.0, "fl_y": 32.0, "cx": 16.0, "cy": 12.0}
    change(small, lambda t: t.update(full))
    torch.testing.assert_close(build(small).cameras.intrinsics, expected.cameras.intrinsics)
    change(small, lambda t: t.update(h=20))
    with pytest.raises(ValueError, match=r"w=32 but the image has 8 x 6 pixels.*larger images of the same shape"):
        build(small)


def test_missing_images_are_looked_for_in_the_folders_of_smaller_ones(tmp_path):
    folder = write_scene(tmp_path / "scene")
    mask(folder)
    expected = build(folder)
    (folder / "images").rename(folder / "images_4")
    (folder / "masks").rename(folder / "masks_4")
    change(folder, lambda t: t.update(w=32, h=24, fl_x=32.0, fl_y=32.0, cx=16.0, cy=12.0))
    found = build(folder)
    assert found.names[0] == "images_4/000.png"
    assert torch.equal(found.images, expected.images)
    assert found.mask is not None
    torch.testing.assert_close(found.cameras.intrinsics, expected.cameras.intrinsics)


# --- fisheyes


def fisheye(folder):
    lens = {
        "camera_model": "OPENCV_FISHEYE",
        "k1": 0.05,
        "k2": -0.01,
        "k3": 0.004,
        "k4": -0.001,
        "fl_x": 3.0,
        "fl_y": 3.1,
    }
    change(folder, lambda t: t.update(lens))
    return build(folder)


def test_projection_inverts_a_fisheye_s_rays(tmp_path):
    cameras = fisheye(write_scene(tmp_path / "scene")).cameras
    views, pixels = torch.arange(6).repeat(30), torch.rand(180, 2, dtype=torch.float64) * torch.tensor([8, 6])
    rays = camera_rays(cameras, views, pixels, 0.0, 1.0, torch.float64)
    back, _ = project(cameras, views, rays.along(torch.full((180, 1), 2.5, dtype=torch.float64))[:, 0])
    torch.testing.assert_close(back, pixels)


def test_lenses_are_those_of_colmap(tmp_path):
    folder = write_scene(tmp_path / "scene")
    pixels = torch.rand(50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * torch.tensor([8, 6])
    bent = {"camera_model": "OPENCV", "k1": 0.05, "k2": -0.01, "p1": 0.002, "p2": -0.001}
    for model, keys in (("OPENCV_FISHEYE", "k1 k2 k3 k4"), ("OPENCV", "k1 k2 p1 p2")):
        if model == "OPENCV":
            change(folder, lambda t: [t.pop(key) for key in ("k3", "k4")] and t.update(bent))
        scene = fisheye(folder) if model == "OPENCV_FISHEYE" else build(folder)
        content = json.loads((folder / "transforms.json").read_text())
        params = [content[key] for key in ["fl_x", "fl_y", "cx", "cy", *keys.split()]]
        camera = pycolmap.Camera(model=model, width=8, height=6, params=params)
        x, y = camera.cam_from_img(pixels.numpy()).T
        expected = torch.from_numpy(np.stack([x, -y, -np.ones(50)], axis=1))
        expected /= torch.linalg.vector_norm(expected, dim=1, keepdim=True)
        directions = camera_directions(scene.cameras, torch.zeros(50, dtype=torch.int64), pixels)
        torch.testing.assert_close(directions, expected, atol=1e-6, rtol=0)
