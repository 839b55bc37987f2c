"""nerfstudio and instant-ngp folders: what is read, and what is refused with one line."""

import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from qnerf.geometry.rays import RayTable
from qnerf.scenes import SCENES
from qnerf.scenes.images import area_downscale
from tests.helpers.configs import DATA
from tests.helpers.scenes import write_scene


def build(folder: Path, **options):
    return SCENES.build("nerfstudio", path=str(folder), **options)


def change(folder: Path, edit) -> None:
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    result = edit(content)
    file.write_text(json.dumps(content if result is None else result))


def refused(folder: Path, *needles: str, **options) -> str:
    with pytest.raises(ValueError) as error:  # noqa: PT011
        build(folder, **options)
    message = str(error.value)
    assert "\n" not in message
    for needle in needles:
        assert needle in message, message
    return message


def test_a_folder_is_read(tiny_scene):
    scene = build(tiny_scene)
    assert scene.name == "nerfstudio"
    assert scene.images.shape == (6, 6, 8, 3)
    assert scene.images.dtype == torch.uint8
    assert scene.names == [f"images/{view:03d}.png" for view in range(6)]
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


def test_frames_are_sorted_by_file_name(tiny_scene):
    before = build(tiny_scene)
    change(tiny_scene, lambda t: t["frames"].reverse())
    after = build(tiny_scene)
    assert after.names == before.names
    assert after.fingerprint == before.fingerprint
    torch.testing.assert_close(after.cameras.poses, before.cameras.poses)


def test_the_fingerprint_is_of_the_contents(tiny_scene, tmp_path):
    one = build(tiny_scene).fingerprint
    shutil.copytree(tiny_scene, tmp_path / "elsewhere")
    assert build(tmp_path / "elsewhere").fingerprint == one
    seen = {one}

    def look(edit) -> None:
        copy = tmp_path / f"copy{len(seen)}"
        shutil.copytree(tiny_scene, copy)
        edit(copy)
        seen.add(build(copy).fingerprint)

    look(lambda f: change(f, lambda t: t.update(fl_x=8.5)))
    look(lambda f: change(f, lambda t: t.update(k1=0.01)))
    look(lambda f: change(f, lambda t: t["frames"][2]["transform_matrix"][0].__setitem__(3, 0.25)))
    look(lambda f: Image.new("RGB", (8, 6)).save(f / "images" / "003.png"))
    look(lambda f: change(f, lambda t: t.update(test_filenames=["images/000.png"])))
    seen.add(build(tiny_scene, downscale=2).fingerprint)
    assert len(seen) == 7


def test_intrinsics_shared_or_of_each_frame(tiny_scene):
    def edit(t):
        t.update(k1=0.01, k2=0.002, p1=0.001, p2=-0.002)
        t["frames"][1].update(fl_x=9.0, cy=2.5, k1=0.0)
        t["frames"][2].update(camera_angle_x=1.0)  # a frame's own angle wins over the shared focal length

    change(tiny_scene, edit)
    cameras = build(tiny_scene).cameras
    assert cameras.fx.tolist() == pytest.approx([8, 9, 4 / np.tan(0.5), 8, 8, 8])
    assert cameras.fy.tolist() == pytest.approx([8, 9, 4 / np.tan(0.5), 8, 8, 8])
    assert cameras.cy.tolist() == pytest.approx([3, 2.5, 3, 3, 3, 3])
    assert cameras.distortion[1].tolist() == pytest.approx([0, 0.002, 0.001, -0.002])
    assert cameras.distortion[5].tolist() == pytest.approx([0.01, 0.002, 0.001, -0.002])


def test_angles_of_view_give_focal_lengths(tiny_scene):
    def edit(t):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del t[key]
        t.update(camera_angle_x=0.8, camera_angle_y=0.7)

    change(tiny_scene, edit)
    cameras = build(tiny_scene).cameras
    assert float(cameras.fx[0]) == pytest.approx(4 / np.tan(0.4))
    assert float(cameras.fy[0]) == pytest.approx(3 / np.tan(0.35))
    assert (float(cameras.cx[0]), float(cameras.cy[0])) == (4, 3)


def test_suffixes_may_be_left_out(tiny_scene):
    change(tiny_scene, lambda t: [f.update(file_path=f["file_path"][:-4]) for f in t["frames"]] and None)
    assert build(tiny_scene).names[0] == "images/000.png"


@pytest.mark.parametrize(
    "name", ["a b.png", "ünï-漢字.png", "100%#?&'\".png", "new\nline.png", "~.png", "-x.png", "..x.png"]
)
def test_odd_file_names(tiny_scene, name):
    os.rename(tiny_scene / "images" / "001.png", tiny_scene / "images" / name)
    change(tiny_scene, lambda t: t["frames"][1].update(file_path=f"images/{name}"))
    assert f"images/{name}" in build(tiny_scene).names
    (tiny_scene / "images" / name).unlink()
    refused(tiny_scene, "1 of 6 images are missing", repr(f"images/{name}"))


def test_the_file_s_own_split(tiny_scene):
    names = [f"images/{view:03d}.png" for view in range(6)]
    before = build(tiny_scene)
    change(
        tiny_scene,
        lambda t: t.update(train_filenames=names[2:5], test_filenames=["./" + names[0]], val_filenames=names[5:]),
    )
    scene = build(tiny_scene)
    assert scene.names == [names[i] for i in (0, 2, 3, 4)]
    assert (scene.train, scene.eval) == ([1, 2, 3], [0])
    torch.testing.assert_close(scene.transform, before.transform)  # over all frames, whichever are used
    torch.testing.assert_close(scene.cameras.poses[1], before.cameras.poses[2])

    change(tiny_scene, lambda t: t.pop("test_filenames") and None)
    scene = build(tiny_scene)
    assert [scene.names[i] for i in scene.eval] == names[5:]
    change(tiny_scene, lambda t: t.pop("train_filenames") and None)
    scene = build(tiny_scene)
    assert [scene.names[i] for i in scene.train] == names[:5]


def test_a_split_in_error_is_refused(tiny_scene):
    change(tiny_scene, lambda t: t.update(train_filenames=["images/000.png", "nope.png"]))
    refused(tiny_scene, "train_filenames", "'nope.png'", "no frame")
    both = ["images/000.png", "images/001.png"]
    change(tiny_scene, lambda t: t.update(train_filenames=both, test_filenames=both[1:]))
    refused(tiny_scene, "'images/001.png'", "training and in the evaluation")
    change(tiny_scene, lambda t: t.update(train_filenames=7))
    refused(tiny_scene, "train_filenames must be a list")
    everything = [f"images/{view:03d}.png" for view in range(6)]
    change(tiny_scene, lambda t: t.pop("test_filenames") and t.update(train_filenames=everything))
    refused(tiny_scene, "no image to evaluate")


def test_missing_images(tiny_scene):
    for name in ("004", "001"):
        (tiny_scene / "images" / f"{name}.png").unlink()
    refused(tiny_scene, "2 of 6 images are missing", "'images/001.png'", "scene.skip_missing=true")
    scene = build(tiny_scene, skip_missing=True)
    assert scene.names == [f"images/{view:03d}.png" for view in (0, 2, 3, 5)]
    for name in ("000", "002"):
        (tiny_scene / "images" / f"{name}.png").unlink()
    refused(tiny_scene, "at least 3 images, got 2", skip_missing=True)


# --- bad input


def test_a_path_that_is_no_scene(tmp_path):
    refused(tmp_path / "nowhere", "nowhere", "does not exist")
    (tmp_path / "file").write_text("")
    refused(tmp_path / "file", "is not a folder")
    refused(tmp_path, "no transforms.json")
    (tmp_path / "transforms_train.json").write_text("{}")
    refused(tmp_path, "scene=blender")


@pytest.mark.parametrize("text", ["", "{", "nope", "\x00", "[" * 100_000, '{"frames": [1,]}', "\udcff"])
def test_not_json(tiny_scene, text):
    (tiny_scene / "transforms.json").write_bytes(text.encode(errors="surrogateescape"))
    refused(tiny_scene, "transforms.json is not JSON")


@pytest.mark.parametrize("content", [[], 3, None, "x", {}, {"frames": []}, {"frames": {}}, {"frames": None}])
def test_no_frames(tiny_scene, content):
    change(tiny_scene, lambda t: content if content is not None else 0)
    refused(tiny_scene, "transforms.json", "frames")


def frame(**keys):
    return lambda t: t["frames"][2].update(keys)


@pytest.mark.parametrize(
    ("edit", "needles"),
    [
        (lambda t: t["frames"].__setitem__(2, 5), ("frame 2 must be an object",)),
        (frame(file_path=7), ("file_path of frame 2", "7")),
        (frame(file_path=""), ("file_path of frame 2",)),
        (frame(file_path=None), ("file_path of frame 2",)),
        (lambda t: t["frames"][2].pop("transform_matrix") and None, ("'images/002.png' has no transform_matrix",)),
        (frame(transform_matrix="x"), ("'images/002.png'", "4 x 4")),
        (frame(transform_matrix=[[1, 2], [3]]), ("'images/002.png'", "4 x 4")),
        (frame(transform_matrix=[[1, 0], [0, 1]]), ("'images/002.png'", "4 x 4")),
        (frame(transform_matrix=None), ("'images/002.png'", "transform_matrix")),
        (frame(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()), ("'images/002.png'", "not rigid")),
        (frame(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()), ("'images/002.png'", "mirrors")),
        (frame(transform_matrix=np.full((4, 4), np.nan).tolist()), ("'images/002.png'", "NaN")),
        (frame(transform_matrix=np.full((4, 4), 1e300).tolist()), ("'images/002.png'", "beyond 1e+12")),
        (frame(file_path="images/001.png"), ("'images/001.png' twice",)),
        (frame(file_path="./images/../images/001.png"), ("twice",)),
        (frame(fl_x=0), ("'images/002.png'", "fl_x must be above 0")),
        (frame(fl_x=-3.5), ("fl_x must be above 0, got -3.5",)),
        (frame(fl_x="8"), ("fl_x must be a finite number, got '8'",)),
        (frame(fl_y=True), ("fl_y must be a finite number",)),
        (frame(cx=float("nan")), ("cx must be a finite number",)),
        (frame(cx=10**400), ("cx must be a finite number",)),
        (frame(camera_angle_x=4.0), ("camera_angle_x must be between 0 and pi",)),
        (frame(k3=0.1), ("k3=0.1 is not supported", "k1, k2, p1, p2")),
        (frame(k1=-5.0), ("'images/002.png'", "k1=-5", "folds the image")),
        (frame(k2=float("inf")), ("k2 must be a finite number",)),
        (frame(w=9), ("w=9 but the image has 8 x 6",)),
        (lambda t: t.update(camera_model="FOV"), ("'FOV' is not supported", "OPENCV_FISHEYE", "qnerf capture")),
        (lambda t: t.update(camera_model=["OPENCV"]), ("is not supported",)),
        (lambda t: t.update(is_fisheye="false"), ("is_fisheye must be true or false, got 'false'",)),
        (lambda t: t.update(is_fisheye=True, p1=0.1), ("p1=0.1 of a fisheye", "k1, k2, k3, k4")),
        (lambda t: t.update(camera_model="OPENCV_FISHEYE", k1=-1.0), ("k1=-1 k2=0 k3=0 k4=0 folds",)),
        (lambda t: [t.pop(key) for key in ("fl_x", "fl_y")] and None, ("no intrinsics", "fl_x", "camera_angle_x")),
        (lambda t: t.update(frames=t["frames"][:2]), ("at least 3 images, got 2",)),
        (
            lambda t: [f.update(transform_matrix=t["frames"][0]["transform_matrix"]) for f in t["frames"]] and None,
            ("all cameras stand at the same point",),
        ),
    ],
)
def test_bad_frames(tiny_scene, edit, needles):
    change(tiny_scene, edit)
    refused(tiny_scene, *needles)


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/passwd", "images/../../secret.png", "../scene/../secret", "link.png"]
)
def test_images_outside_the_folder_are_refused(tiny_scene, name):
    shutil.copy(tiny_scene / "images" / "000.png", tiny_scene.parent / "secret.png")
    os.symlink(tiny_scene.parent / "secret.png", tiny_scene / "link.png")
    change(tiny_scene, frame(file_path=name))
    refused(tiny_scene, repr(name), "outside the scene's folder")


def test_a_scene_behind_a_link_and_links_inside_it_are_fine(tiny_scene, tmp_path):
    (tiny_scene / "images" / "002.png").rename(tiny_scene / "real.png")
    os.symlink("../real.png", tiny_scene / "images" / "002.png")
    os.symlink(tiny_scene, tmp_path / "link")
    assert build(tmp_path / "link").fingerprint == build(tiny_scene).fingerprint


@pytest.mark.parametrize("name", ["images/" + "x" * 5000, "images", "images/\0.png", "images/nothing\ud800"])
def test_names_that_no_file_can_have(tiny_scene, name):
    change(tiny_scene, frame(file_path=name))
    refused(tiny_scene, repr(name))


def test_images_of_differing_size(tiny_scene):
    Image.new("RGB", (8, 5)).save(tiny_scene / "images" / "003.png")
    refused(tiny_scene, "'images/003.png': h=6 but the image has 8 x 5 pixels")


def png(width: int, height: int, data: bytes = b"") -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "data", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n"]
)
def test_files_that_are_no_images(tiny_scene, data):
    (tiny_scene / "images" / "003.png").write_bytes(data)
    refused(tiny_scene, "'images/003.png' cannot be read")


def test_images_that_are_cut_short_or_damaged(tiny_scene):
    file = tiny_scene / "images" / "003.png"
    whole = file.read_bytes()
    for data in (whole[:60], png(8, 6, zlib.compress(b"\0" * 10)), png(8, 6, b"no zlib stream")):
        file.write_bytes(data)
        refused(tiny_scene, "'images/003.png' does not decode")


@pytest.mark.parametrize(("width", "height"), [(30_000, 30_000), (9_000, 8_000), (2**31 - 1, 2**31 - 1)])
def test_enormous_images_are_refused_before_they_are_decoded(tiny_scene, width, height):
    (tiny_scene / "images" / "003.png").write_bytes(png(width, height, zlib.compress(b"")))
    refused(tiny_scene, "'images/003.png'", "not decoded")


# --- pixels


@pytest.mark.parametrize("factor", [0, -1, 7])
def test_downscale_out_of_range(tiny_scene, factor):
    refused(tiny_scene, "downscale", str(factor), downscale=factor)


@pytest.mark.parametrize("factor", [1.5, True, "2", None])
def test_downscale_must_be_an_integer(tiny_scene, factor):
    refused(tiny_scene, "downscale expects int", downscale=factor)


def test_downscaling_averages_areas_and_scales_intrinsics(tmp_path):
    folder = write_scene(tmp_path / "scene", width=11, height=7)
    full, small = build(folder), build(folder, downscale=3)
    assert small.images.shape == (6, 2, 3, 3)
    cut = full.images[:, :6, :9].double().reshape(6, 2, 3, 3, 3, 3).mean(dim=(2, 4))
    assert float((small.images - cut).abs().max()) <= 0.5
    assert (small.cameras.width, small.cameras.height) == (3, 2)
    # the remainder is cut off at the right and bottom, so that corners of blocks see what they saw
    a = RayTable(full, dtype=torch.float64).view(0).directions.view(7, 11, 3)
    b = RayTable(small, dtype=torch.float64).view(0).directions.view(2, 3, 3)
    torch.testing.assert_close(a[1:6:3, 1:9:3], b)  # centre of a 3 x 3 block = centre of its middle pixel


def test_area_means_are_rounded_half_up_and_weighted_by_alpha():
    grey = np.array([[[1, 1, 1], [2, 2, 2]], [[2, 2, 2], [1, 1, 1]]], np.uint8)
    assert area_downscale(grey, 2).tolist() == [[[2, 2, 2]]]
    image = np.zeros((2, 2, 4), np.uint8)
    image[0, 0], image[0, 1], image[1, 0] = (200, 0, 0, 255), (0, 100, 0, 85), (77, 77, 77, 0)
    assert area_downscale(image, 2).tolist() == [[[150, 25, 0, 85]]]
    assert area_downscale(image * 0, 2).tolist() == [[[0, 0, 0, 0]]]


def test_alpha_is_kept_where_there_is_any(tmp_path):
    folder = write_scene(tmp_path / "scene", channels=4)
    assert build(folder).images.shape[-1] == 4
    for view in range(6):
        Image.new("RGBA", (8, 6), (1, 2, 3, 255)).save(folder / "images" / f"{view:03d}.png")
    assert build(folder).images.shape[-1] == 3
    Image.new("RGBA", (8, 6), (1, 2, 3, 254)).save(folder / "images" / "003.png")
    images = build(folder).images
    assert images[3, 0, 0].tolist() == [1, 2, 3, 254]
    assert images[2, 0, 0].tolist() == [1, 2, 3, 255]


def test_other_kinds_of_pixels(tiny_scene):
    images = tiny_scene / "images"
    Image.new("L", (8, 6), 7).save(images / "000.png")
    Image.fromarray(np.full((6, 8), 257 * 9 + 3, np.uint16)).save(images / "001.png")
    Image.new("1", (8, 6), 1).save(images / "002.png")
    Image.new("P", (8, 6)).save(images / "003.png")
    Image.new("CMYK", (8, 6)).save(images / "004.jpg")
    change(tiny_scene, lambda t: t["frames"][4].update(file_path="images/004.jpg"))
    scene = build(tiny_scene)
    assert scene.images[:4, 0, 0].tolist() == [[7] * 3, [9] * 3, [255] * 3, [0] * 3]
    Image.fromarray(np.zeros((6, 8), np.float32)).save(images / "004.tif")
    change(tiny_scene, lambda t: t["frames"][4].update(file_path="images/004.tif"))
    refused(tiny_scene, "'images/004.tif' does not decode", "floating-point")


# --- real data


@pytest.mark.skipif(not (DATA / "fox_64").is_dir(), reason="no fox_64")
def test_the_fox():
    scene = build(DATA / "fox_64")
    cameras = scene.cameras
    assert scene.images.shape == (50, 64, 36, 3)
    assert (len(scene.train), len(scene.eval)) == (45, 5)
    assert float(cameras.poses[:, :, 3].abs().max()) == pytest.approx(1)
    # the optical axes meet near one point, which all cameras have in front of them
    centre, ahead = cameras.poses[:, :, 3], -cameras.poses[:, :, 2]
    across = torch.eye(3).double() - ahead[:, :, None] * ahead[:, None, :]
    meeting = torch.linalg.solve(across.sum(0), (across @ centre[:, :, None]).sum(0))[:, 0]
    miss = (across @ (meeting - centre)[:, :, None]).norm(dim=1)
    assert float(miss.median()) < 0.3
    assert float(((meeting - centre) * ahead).sum(1).min()) > 0.5


@pytest.mark.skipif(not (DATA / "fox_256").is_dir(), reason="no fox_256")
def test_the_fox_downscaled():
    large, small = build(DATA / "fox_256"), build(DATA / "fox_256", downscale=4)
    torch.testing.assert_close(small.cameras.fx, large.cameras.fx / 4)
    torch.testing.assert_close(small.cameras.poses, large.cameras.poses)
    assert small.images.shape == (50, 64, 36, 3)
    if (DATA / "fox_64").is_dir():  # made from the same photographs by the same filter, in one step
        other = build(DATA / "fox_64")
        assert float((small.images.float() - other.images.float()).abs().mean()) < 1
        torch.testing.assert_close(small.cameras.fx, other.cameras.fx)


@pytest.mark.skipif(not (DATA / "chair_64").is_dir(), reason="no chair_64")
def test_the_chair_s_own_split():
    scene = build(DATA / "chair_64")
    assert (len(scene.train), len(scene.eval)) == (100, 200)
    assert {scene.names[view].split("/")[0] for view in scene.train} == {"train"}
    assert {scene.names[view].split("/")[0] for view in scene.eval} == {"test"}
