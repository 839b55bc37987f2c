"""transforms.json of nerfstudio and instant-ngp: what is read, and what is refused with one line."""

import io
import json
import math
import shutil
import unicodedata

import numpy as np
import pytest
import torch
from PIL import Image

from qnerf.cli.errors import MAX_MESSAGE, one_line
from qnerf.config import memory
from qnerf.scenes import images
from qnerf.scenes.area import area_downscale
from tests.helpers import scenes
from tests.helpers.scenes import change, change_frame, write_scene

NAMES = [f"images/{view:03d}.png" for view in range(6)]


def build(folder, **options):
    return scenes.build("nerfstudio", folder, **options)


def refused(folder, *needles, **options):
    return scenes.refused("nerfstudio", folder, *needles, **options)


@pytest.fixture
def copies(tiny_scene, tmp_path):
    """Fresh copies of the scene, one after another."""
    return (shutil.copytree(tiny_scene, tmp_path / f"copy {number}") for number in range(1000))


def test_a_folder_is_read_and_described(tiny_scene):
    scene = build(tiny_scene)
    assert scene.name == "nerfstudio"
    assert scene.images.shape == (6, 6, 8, 3)
    assert scene.images.dtype == torch.uint8
    assert scene.names == NAMES
    assert (scene.train, scene.eval) == ([0, 1, 2, 3, 5], [4])
    assert (scene.cameras.width, scene.cameras.height) == (8, 6)
    assert scene.cameras.poses.dtype == torch.float64
    for view, name in enumerate(scene.names):
        np.testing.assert_array_equal(scene.images[view], np.asarray(Image.open(tiny_scene / name)))
    # all six look at the origin, and so they do in the normalised world
    target = scene.transform[:3, 3]
    ahead = -scene.cameras.poses[:, :, 2]
    towards = torch.nn.functional.normalize(target - scene.cameras.poses[:, :, 3], dim=1)
    torch.testing.assert_close(ahead, towards)
    assert scene.description() == "6 views of 8 x 6 pixels, 5 train, 1 held out, 0 masks"


def test_a_description_lists_what_was_not_read(tiny_scene):
    change(tiny_scene, lambda t: t.update(aabb_scale=4, ply_file_path="points.ply"))
    change(tiny_scene, lambda t: t.update(train_filenames=NAMES[:3], test_filenames=NAMES[5:]))
    change(tiny_scene, lambda t: [frame.update(depth_file_path="depths/0.png") for frame in t["frames"]])
    for name in ("images/extra.png", "depths/0.png", "points.ply", ".hidden", "images_4/000.png"):
        (tiny_scene / name).parent.mkdir(exist_ok=True)
        shutil.copy(tiny_scene / NAMES[0], tiny_scene / name)
    told = build(tiny_scene).description()
    assert told.startswith("4 views of 8 x 6 pixels, 3 train, 1 held out, 0 masks; ")
    assert told.split("; ")[1:] == [
        "keys not read: depth_file_path, ply_file_path, aabb_scale",
        "2 posed images not used",
        "1 images without a pose",
        "files not read: depths/, points.ply",
    ]


def test_comments_are_skipped_as_by_instant_ngp(tiny_scene):
    fingerprint = build(tiny_scene).fingerprint
    file = tiny_scene / "transforms.json"
    file.write_text(
        "// made by hand\n" + file.read_text().replace('"frames"', '/* all " of them */ "note": "//", "frames"')
    )
    assert build(tiny_scene).fingerprint == fingerprint


# --- intrinsics


@pytest.mark.parametrize(("key", "said"), [("camera_angle_x", True), ("camera_angle_y", False), ("fl_x", False)])
def test_an_angle_across_the_shorter_side_is_said(tmp_path, key, said):
    folder = write_scene(tmp_path / "scene", width=6, height=8)
    change(folder, lambda t: [t.pop(name) for name in ("fl_x", "fl_y")])
    change(folder, lambda t: t.update({key: 7.0 if key == "fl_x" else 0.7}))
    scene = build(folder)
    assert ("camera_angle_x (or x_fov) is taken across the width, the shorter side" in scene.description()) is said
    side = {"camera_angle_x": 6, "camera_angle_y": 8}
    expected = side[key] / 2 / math.tan(0.35) if key in side else 7.0
    assert float(scene.cameras.fx[0]) == float(scene.cameras.fy[0]) == pytest.approx(expected)


def test_a_view_far_out_is_named(tmp_path):
    folder = write_scene(tmp_path / "scene", views=8)
    assert "farther out" not in build(folder).description()
    change(folder, lambda t: t["frames"][3]["transform_matrix"][0].__setitem__(3, 2e4))
    scene = build(folder)
    assert "farther out than all others: images/003.png" in scene.description()
    assert float(np.delete(scene.cameras.poses[:, :, 3].numpy(), 3, axis=0).max()) <= 1


def test_intrinsics_shared_or_of_each_frame(tiny_scene):
    change(tiny_scene, lambda t: t.update(k1=0.01, k2=0.002, p1=0.001, p2=-0.002))
    change_frame(tiny_scene, 1, fl_x=9.0, cy=2.5, k1=0.0)
    change_frame(tiny_scene, 2, camera_angle_x=1.0)  # a frame's own angle wins over the shared focal length
    change_frame(tiny_scene, 3, K=[[7.5, 0, 4.25], [0, 7.25, 3.5], [0, 0, 1]])
    change_frame(tiny_scene, 4, x_fov=60.0, y_fov=50.0)  # instant-ngp's, in degrees
    cameras = build(tiny_scene).cameras
    wide, high = 4 / np.tan(np.radians(30)), 3 / np.tan(np.radians(25))
    assert cameras.fx.tolist() == pytest.approx([8, 9, 4 / np.tan(0.5), 7.5, wide, 8])
    assert cameras.fy.tolist() == pytest.approx([8, 9, 4 / np.tan(0.5), 7.25, high, 8])
    assert cameras.cx.tolist() == pytest.approx([4, 4, 4, 4.25, 4, 4])
    assert cameras.cy.tolist() == pytest.approx([3, 2.5, 3, 3.5, 3, 3])
    assert cameras.distortion[1].tolist() == pytest.approx([0, 0.002, 0.001, -0.002])
    assert cameras.distortion[5].tolist() == pytest.approx([0.01, 0.002, 0.001, -0.002])


def test_a_focal_length_in_another_unit_is_refused(copies):
    """Image widths, pixels of larger images, degrees, millimetres, and a part of the angle."""
    for wrong in ({"fl_x": 0.25}, {"fl_x": 162 * 8.0}, {"camera_angle_x": 40.0}, {"camera_angle_x": 0.01}):
        folder = next(copies)
        change(folder, lambda t: [t.pop(key) for key in ("fl_x", "fl_y", "cx", "cy")])
        change(folder, lambda t, wrong=wrong: t.update(wrong))
        refused(folder, "fl_x and fl_y are in pixels of images of w x h pixels, camera_angle_x and")


# --- names of images


def test_names_stand_for_files_as_in_the_formats_own_readers(copies):
    """Suffixes left out or doubled, backslashes, paths of where the folder was before, letter case, Unicode form."""
    composed, other = (unicodedata.normalize(form, "ü") for form in ("NFC", "NFD"))
    for file, name in (
        ("images/001.png", "images/001"),
        ("images/001.png", "images/001.png.png"),
        ("images/001.png.png", "images/001.png"),
        ("images/001.jpg.png", "images/001.jpg"),
        ("images/001.png", "images\\001.png"),
        ("images/001.png", ".\\images\\001"),
        ("images/a\\b.png", "images/a\\b.png"),
        ("images/001.png", "{folder}/images/001.png"),
        ("images/001.png", "../{name}/images/001.png"),
        ("images/001.png", "/home/someone/captures/tree/images/001.png"),
        ("images/001.png", "C:\\Users\\someone\\tree\\images\\001.png"),
        ("images/001.png", "/images/001.png"),
        ("images/001.png", "./..\\data\\tree\\images/001.png"),
        ("images/001.PNG", "images/001.png"),
        ("Images/001.png", "images/001.PNG"),
        ("images/001.JPEG", "images/001"),
        (f"images/{composed}.png", f"images/{other}.png"),
        (f"images/{other}.png", f"images/{composed.upper()}.png"),
        *((f"images/{odd}.png", f"images/{odd}.png") for odd in ("a b", "漢字", "100%#?&'\"", "new\nline", "~", "..x")),
    ):
        folder = next(copies)
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / NAMES[1]).rename(folder / file)
        change_frame(folder, 1, file_path=name.format(folder=folder, name=folder.name))
        assert build(folder).names.count(file) == 1, name
        (folder / file).unlink()
        message = refused(folder, "1 of 6 images are missing")
        assert repr(name.format(folder=folder, name=folder.name)) in message


def test_names_that_stand_for_several_files_or_for_none_inside_are_refused(tiny_scene):
    shutil.copy(tiny_scene / NAMES[2], tiny_scene / "images" / "B.png")
    shutil.copy(tiny_scene / NAMES[2], tiny_scene / "images" / "b.PNG")
    change_frame(tiny_scene, file_path="images/b.png")
    refused(tiny_scene, "may stand for images/B.png, images/b.PNG; write the name of one of them")
    change_frame(tiny_scene, file_path="images/B.png")
    build(tiny_scene)
    outside = tiny_scene.parent / "outside.png"
    shutil.copy(tiny_scene / NAMES[2], outside)
    for name in (
        "../outside.png",
        "../outside",
        str(outside),
        str(outside)[:-4],
        "images/../../outside.png",
        "..",
        "/etc/passwd",
    ):
        change_frame(tiny_scene, file_path=name)
        refused(tiny_scene, repr(name), "outside the scene's folder; copy it into the folder, and write its path")
    outside.rename(tiny_scene / "inside.png")
    change_frame(tiny_scene, file_path="inside.png")
    build(tiny_scene)


def test_transforms_refuse_one_image_under_two_names(tiny_scene):
    (tiny_scene / "link.png").symlink_to(tiny_scene / NAMES[0])
    for name in ("images/000", "link.png", "IMAGES/000.png"):
        change_frame(tiny_scene, file_path=name)
        refused(tiny_scene, "one image file twice", "'images/000.png'", repr(name))
    for name in (NAMES[1], "./images/../images/001.png", "images\\001.png"):
        change_frame(tiny_scene, file_path=name)
        refused(tiny_scene, "twice")


def test_missing_images_are_left_out_where_enough_are_left(tiny_scene):
    for name in (NAMES[4], NAMES[1]):
        (tiny_scene / name).unlink()
    refused(
        tiny_scene, "2 of 6 images are missing", "'images/001.png'", "scene.skip_missing=true goes on with the other 4"
    )
    scene = build(tiny_scene, skip_missing=True)
    assert scene.names == [NAMES[view] for view in (0, 2, 3, 5)]
    assert scene.description().endswith("2 missing images left out")
    for name in (NAMES[0], NAMES[2]):
        (tiny_scene / name).rename(tiny_scene / name.replace("00", "renamed"))
    for skip in (False, True):
        message = refused(
            tiny_scene,
            "4 of 6 images are missing",
            "at least 3, to train on and to hold out, are needed",
            skip_missing=skip,
        )
        assert "skip_missing" not in message
        assert message.endswith("images has 2 other images, such as 'renamed0.png'")
    change_frame(tiny_scene, 0, file_path="images/renamed0.png")
    build(tiny_scene, skip_missing=True)


# --- the split


def test_the_file_s_own_split(tiny_scene):
    before = build(tiny_scene)
    train = [NAMES[2], "images/003", "IMAGES/004.PNG"]
    lists = {"train_filenames": train, "test_filenames": [".\\images\\000.png"], "val_filenames": NAMES[5:]}
    change(tiny_scene, lambda t: t.update(lists))
    scene = build(tiny_scene)
    assert scene.names == [NAMES[i] for i in (0, 2, 3, 4)]
    assert (scene.train, scene.eval) == ([1, 2, 3], [0])
    torch.testing.assert_close(scene.transform, before.transform)  # over all frames, whichever are used
    torch.testing.assert_close(scene.cameras.poses[1], before.cameras.poses[2])
    change(tiny_scene, lambda t: t.pop("test_filenames"))
    scene = build(tiny_scene)
    assert [scene.names[i] for i in scene.eval] == NAMES[5:]
    change(tiny_scene, lambda t: t.pop("train_filenames"))
    scene = build(tiny_scene)
    assert [scene.names[i] for i in scene.train] == NAMES[:5]


def test_a_split_in_error_is_refused(tiny_scene):
    both = NAMES[:2]
    for lists, *needles in (
        ({"train_filenames": ["images/000.png", "nope.png"]}, "train_filenames", "'nope.png'", "no frame"),
        ({"train_filenames": both, "test_filenames": both[1:]}, "'images/001.png'", "training and in the evaluation"),
        ({"train_filenames": 7, "test_filenames": []}, "train_filenames must be a list"),
        *(({"train_filenames": value}, "train_filenames must be a list") for value in (False, 0, "", {})),
        ({"train_filenames": NAMES}, "no image to evaluate"),
    ):
        change(tiny_scene, lambda t, lists=lists: t.update(lists))
        refused(tiny_scene, *needles)


# --- bad input


def test_files_that_are_no_scene(tmp_path, tiny_scene):
    refused(tmp_path / "nowhere", "nowhere", "does not exist")
    refused(tiny_scene / "transforms.json", "is not a folder", f"scene.path={tiny_scene}")
    refused(tiny_scene / "images", "no transforms.json", "it has 6 images without poses: `qnerf capture ")
    file = tiny_scene / "transforms.json"
    for text in ("", "{", "nope", "\x00", "[" * 100_000, '{"frames": [1,]}', "\udcff", '{"frames": [' + "9" * 5000):
        file.write_bytes(text.encode(errors="surrogateescape"))
        refused(tiny_scene, "transforms.json is not JSON")
    for content in ([], 3, "x", {}, {"frames": []}, {"frames": {}}, {"frames": None}):
        file.write_text(json.dumps(content))
        refused(tiny_scene, "transforms.json", "frames")


def test_transforms_name_bad_frames(copies):
    nan = float("nan")
    for keys, *needles in (
        ({"file_path": 7}, "file_path of frame 2", "7"),
        ({"file_path": ""}, "file_path of frame 2"),
        ({"file_path": None}, "file_path of frame 2"),
        *(
            ({"transform_matrix": rows}, "'images/002.png'", "4 x 4")
            for rows in ("x", [[1, 2], [3]], [[1, 0], [0, 1]], None, {"a": 1}, [[[]]], [[1] * 5, [1] * 3, [1] * 4])
        ),
        *(
            ({"transform_matrix": [[1, 0, 0, value], *np.eye(4)[1:].tolist()]}, "'images/002.png'", "NaN")
            for value in (nan, math.inf, 1e300, 10**400, "1.0", True, None, [0])
        ),
        ({"transform_matrix": np.diag([2.0, 1, 2, 1]).tolist()}, "'images/002.png'", "not rigid"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "'images/002.png'", "mirrors"),
        *(({"fl_x": value}, "'images/002.png'", "fl_x must be above 0") for value in (0, -3.5)),
        *(
            ({key: value}, f"{key} must be a finite number")
            for key in ("fl_x", "fl_y", "cx", "k1", "p2", "k3", "w", "h", "camera_angle_x", "x_fov")
            for value in (nan, math.inf, 10**400, "8", [8], True)
        ),
        *(({key: value}, f"{key}=", "degrees") for key in ("fl_x", "fl_y") for value in (1e-300, 1e-4, 1e6)),
        *(({"K": rows}, "K must be") for rows in (5, "x", [[1, 2], [3]], [[8, 1, 4], [0, 8, 3], [0, 0, 1]], [[1, 0]])),
        ({"cx": 1e5}, "cx must be between"),
        ({"k3": 0.1}, "k3=0.1 is not supported", "k1, k2, p1, p2", "qnerf capture"),
        ({"k1": -5.0}, "'images/002.png'", "k1=-5", "folds the image"),
        ({"w": 9}, "w=9 but the image has 8 x 6"),
        ({"camera_model": "FOV"}, "'FOV' is not supported", "OPENCV_FISHEYE", "qnerf capture"),
        *(({"camera_model": value}, "camera model") for value in (["OPENCV"], False, 0, "", {})),
        ({"is_fisheye": "false"}, "is_fisheye must be true or false, got 'false'"),
        ({"is_fisheye": True, "p1": 0.1}, "p1=0.1 of a fisheye", "k1, k2, k3, k4"),
        ({"camera_model": "OPENCV_FISHEYE", "k1": -1.0}, "k1=-1 k2=0 k3=0 k4=0 folds"),
        ({"mask_path": 5}, "mask_path must be a file name, got 5"),
    ):  # fmt: skip
        folder = next(copies)
        change_frame(folder, **keys)
        refused(folder, *needles)


def test_transforms_refuse_bad_files_as_a_whole(copies):
    for edit, needle in (
        (lambda t: t["frames"].__setitem__(2, 5), "frame 2 must be an object"),
        (lambda t: t["frames"][2].pop("transform_matrix"), "'images/002.png' has no transform_matrix"),
        (lambda t: [t.pop(key) for key in ("fl_x", "fl_y")], "has no intrinsics: expected fl_x"),
        (lambda t: t.update(frames=t["frames"][:2]), "/images has 4 other images, such as '002.png'"),
        (
            lambda t: [frame.update(transform_matrix=t["frames"][0]["transform_matrix"]) for frame in t["frames"]],
            "all cameras stand at the same point",
        ),
    ):
        change(folder := next(copies), edit)
        refused(folder, needle)


def test_a_message_is_never_long(tiny_scene):
    change_frame(tiny_scene, 0, file_path="x" * 10**6)
    with pytest.raises(ValueError, match="missing") as error:
        build(tiny_scene)
    assert len(one_line(error.value)) == MAX_MESSAGE


# --- pixels


def test_files_that_are_no_images_are_refused(tiny_scene):
    file = tiny_scene / NAMES[3]
    whole = file.read_bytes()
    others = []
    for kind in ("GIF", "ICO"):
        Image.new("L", (8, 6)).save(data := io.BytesIO(), kind)
        others.append(data.getvalue())
    for data in (
        b"",
        b"hello",
        whole[:8],
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n",
        b"%PDF-1.4\n",
        *others,
    ):
        file.write_bytes(data)
        refused(tiny_scene, "'images/003.png' cannot be read")
    file.write_bytes(whole[:60])
    refused(tiny_scene, "'images/003.png' does not decode")
    Image.new("RGB", (8, 5)).save(file)
    refused(tiny_scene, "'images/003.png': h=6 but the image has 8 x 5 pixels")


def test_kinds_of_pixels(tiny_scene):
    images = tiny_scene / "images"
    Image.new("L", (8, 6), 7).save(images / "000.png")
    Image.fromarray(np.full((6, 8), 257 * 9 + 3, np.uint16)).save(images / "001.png")
    Image.new("1", (8, 6), 1).save(images / "002.png")
    Image.new("P", (8, 6)).save(images / "003.png")
    Image.new("CMYK", (8, 6)).save(images / "004.jpg")
    change_frame(tiny_scene, 4, file_path="images/004.jpg")
    scene = build(tiny_scene)
    assert scene.images[:4, 0, 0].tolist() == [[7] * 3, [9] * 3, [255] * 3, [0] * 3]
    Image.fromarray(np.zeros((6, 8), np.float32)).save(images / "004.tif")
    change_frame(tiny_scene, 4, file_path="images/004.tif")
    refused(tiny_scene, "'images/004.tif' does not decode", "floating-point")


def test_alpha_is_kept_where_there_is_any(tmp_path):
    folder = write_scene(tmp_path / "scene", channels=4)
    pixels = [np.asarray(Image.open(folder / name)).copy() for name in NAMES]
    np.testing.assert_array_equal(build(folder).images, np.stack(pixels))
    for name, image in zip(NAMES, pixels, strict=True):
        image[..., 3] = 255
        Image.fromarray(image).save(folder / name)
    np.testing.assert_array_equal(build(folder).images, np.stack(pixels)[..., :3])
    pixels[2][0, 0, 3] = 254  # one pixel that is not opaque, and one image without alpha
    Image.fromarray(pixels[2]).save(folder / NAMES[2])
    Image.fromarray(pixels[4][..., :3]).save(folder / NAMES[4])
    np.testing.assert_array_equal(build(folder).images, np.stack(pixels))


def test_a_scene_that_does_not_fit_into_memory_is_refused_and_a_smaller_width_fits(tmp_path, monkeypatch):
    folder = write_scene(tmp_path / "scene", width=64, height=48)
    monkeypatch.setattr(memory, "available_bytes", lambda: 6 * 64 * 48 * 3)
    refused(folder, "6 images would take", "are available; use a smaller scene.width")
    monkeypatch.setattr(images, "DECODING_BYTES", 0)
    build(folder, width=32)


def test_area_means_are_rounded_half_up_and_weighted_by_alpha():
    grey = np.array([[[1, 1, 1], [2, 2, 2]], [[2, 2, 2], [1, 1, 1]]], np.uint8)
    assert area_downscale(grey, 2).tolist() == [[[2, 2, 2]]]
    image = np.zeros((2, 2, 4), np.uint8)
    image[0, 0], image[0, 1], image[1, 0] = (200, 0, 0, 255), (0, 100, 0, 85), (77, 77, 77, 0)
    assert area_downscale(image, 2).tolist() == [[[150, 25, 0, 85]]]
    assert area_downscale(image * 0, 2).tolist() == [[[0, 0, 0, 0]]]


# --- real data
