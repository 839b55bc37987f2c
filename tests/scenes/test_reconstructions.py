"""COLMAP models and LLFF folders, and what is said where a folder holds something else."""

import json
import shutil
import struct

import numpy as np
import pycolmap
import pytest
import torch
from scipy.spatial.transform import Rotation

from qnerf.scenes.formats.colmap import MODELS, camera_to_world, read_model
from tests.helpers.scenes import build, refused, write_scene

VIEWS, WIDTH, HEIGHT = 9, 16, 12


@pytest.fixture
def posed(tmp_path):
    return write_scene(tmp_path / "scene", VIEWS, WIDTH, HEIGHT)


def poses(folder):
    """Camera-to-world 4 x 4, as the transforms file has them; the file goes."""
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    return [np.array(frame["transform_matrix"]) for frame in content["frames"]]


def world_to_camera(pose):
    """COLMAP's qw qx qy qz tx ty tz, from its definition."""
    matrix = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return [w, x, y, z, *matrix[:3, 3]]


def write_text(folder, model="PINHOLE 16 12 8 8 8 6", nested="sparse/0"):
    place = folder / nested
    place.mkdir(parents=True)
    (place / "cameras.txt").write_text(f"# Camera list\n7 {model}\n")
    lines = ["# Image list"]
    for view, pose in enumerate(poses(folder)):
        numbers = " ".join(map(repr, map(float, world_to_camera(pose))))
        lines += [f"{view + 1} {numbers} 7 {view:03d}.png", "" if view % 2 else "1.0 2.0 -1 3.0 4.0 5"]
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    return place


def write_binary(folder):
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    (place / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 7, 1, WIDTH, HEIGHT, 8, 8, 8, 6))
    data = struct.pack("<Q", VIEWS)
    for view, pose in enumerate(poses(folder)):
        data += struct.pack("<i7di", view + 1, *world_to_camera(pose), 7) + f"{view:03d}.png".encode() + b"\0"
        data += struct.pack("<Q", 1) + struct.pack("<ddq", 1.0, 2.0, -1)
    (place / "images.bin").write_bytes(data)
    return place


def write_llff(folder, factor=1, from_text=None):
    """factor: by which the file's images are larger; from_text: a model that has the poses."""
    rows = []
    frames = read_model(from_text)["frames"] if from_text else []
    for pose in [np.array(frame["transform_matrix"]) for frame in frames] or poses(folder):
        columns = np.stack([-pose[:3, 1], pose[:3, 0], pose[:3, 2], pose[:3, 3]], axis=1)
        size = np.array([[HEIGHT * factor], [WIDTH * factor], [8.0 * factor]])
        rows.append([*np.concatenate([columns, size], axis=1).ravel(), 0.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def same(one, other):
    torch.testing.assert_close(one.cameras.poses, other.cameras.poses)
    torch.testing.assert_close(one.cameras.intrinsics, other.cameras.intrinsics)
    assert torch.equal(one.images, other.images)


def test_a_reconstruction_is_the_scene_that_it_was_written_from(tmp_path):
    for write, kind in ((write_text, "colmap"), (write_binary, "colmap"), (write_llff, "llff")):
        folder = write_scene(tmp_path / write.__name__, VIEWS, WIDTH, HEIGHT)
        expected = build("nerfstudio", folder)
        write(folder)
        scene = build(kind, folder)
        same(scene, expected)
        assert (scene.eval, len(scene.train)) == ([0, 8], VIEWS - 2)  # every eighth, as in the papers
        assert scene.description() == "9 views of 16 x 12 pixels, 7 train, 2 held out, 0 masks"
        assert build(kind, folder, eval_every=None).eval == expected.eval
        assert scene.fingerprint != build(kind, folder, eval_every=None).fingerprint
        small = build(kind, folder, width=8)
        assert (small.cameras.width, small.cameras.height) == (8, 6)


def test_sparse_points_are_read_with_the_views_that_see_them(tmp_path):
    track = [(2, 0), (7, 3)]  # an image and the number of a point in it
    for write in (write_text, write_binary):
        folder = write_scene(tmp_path / write.__name__, VIEWS, WIDTH, HEIGHT)
        place = write(folder)
        assert build("colmap", folder).points is None
        refused("colmap", folder, "points3D", "No such file", points=True)
        if write is write_text:
            told = " ".join(f"{image} {point}" for image, point in track)
            (place / "points3D.txt").write_text(f"# points\n4 0.1 -0.2 0.3 255 0 0 0.5 {told}\n9 0 0 0 0 0 0 0.5\n")
        else:
            one = struct.pack("<Q3d3BdQ4i", 4, 0.1, -0.2, 0.3, 255, 0, 0, 0.5, 2, *track[0], *track[1])
            (place / "points3D.bin").write_bytes(struct.pack("<Q", 1) + one)
        scene = build("colmap", folder, points=True)
        assert scene.points is not None
        expected = torch.tensor([0.1, -0.2, 0.3, 1.0], dtype=torch.float64) @ scene.transform[:3].T
        assert [scene.names[int(view)] for view in scene.points[:, 0]] == ["images/001.png", "images/006.png"]
        torch.testing.assert_close(scene.points[:, 1:], expected.expand(2, 3))
        assert scene.fingerprint != build("colmap", folder).fingerprint
        for file in place.glob("points3D*"):
            file.write_bytes(file.read_bytes()[:-8].replace(b" 0.5 ", b" x "))
        refused("colmap", folder, "damaged or cut short", points=True)


def test_reconstructions_take_smaller_images(posed):
    expected = build("nerfstudio", posed)
    write_text(posed)
    write_llff(posed, factor=4, from_text=posed / "sparse/0")
    (posed / "images").rename(posed / "images_4")
    same(build("llff", posed), expected)
    same(build("llff", posed, images="images_4"), expected)
    for file in (posed / "images_4").iterdir():
        file.rename(file.with_suffix(".bmp"))
    same(build("colmap", posed, images="images_4"), expected)


def test_photographs_may_lie_in_the_scene_s_folder_itself(posed):
    expected = build("nerfstudio", posed)
    write_text(posed, nested="colmap/sparse/0")
    for file in list((posed / "images").iterdir()):
        file.rename(posed / file.name)
    same(build("colmap", posed), expected)
    (posed / "003.png").unlink()
    refused("colmap", posed, "1 of 9 images are missing, the first is 'images/003.png'", "scene.skip_missing=true")
    assert len(build("colmap", posed, skip_missing=True).names) == VIEWS - 1


def test_camera_models_of_colmap_are_read_or_refused(posed):
    place = write_text(posed)
    for model, lens in (
        ("SIMPLE_PINHOLE 16 12 9 8 6", [9, 9, 8, 6, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL 16 12 9 8 6 0.1", [9, 9, 8, 6, 0.1, 0, 0, 0]),
        ("RADIAL 16 12 9 8 6 0.1 0.01", [9, 9, 8, 6, 0.1, 0.01, 0, 0]),
        ("OPENCV 16 12 9 8 8 6 0.1 0.01 0.002 0.003", [9, 8, 8, 6, 0.1, 0.01, 0.002, 0.003]),
        ("FULL_OPENCV 16 12 9 8 8 6 0.1 0 0 0 0 0 0 0", [9, 8, 8, 6, 0.1, 0, 0, 0]),
        ("OPENCV_FISHEYE 16 12 9 8 8 6 0.1 0.01 0.002 0.003", [9, 8, 8, 6, 0.1, 0.01, 0.002, 0.003]),
        ("RADIAL_FISHEYE 16 12 9 8 6 0.1 0.01", [9, 9, 8, 6, 0.1, 0.01, 0, 0]),
    ):
        (place / "cameras.txt").write_text(f"7 {model}\n")
        cameras = build("colmap", posed).cameras
        assert cameras.intrinsics[3].tolist() == lens
        assert (cameras.fisheye is not None) is ("FISHEYE" in model)
    for model, *needles in (
        ("FOV 16 12 8 8 8 6 0.1", "camera model FOV is not supported; known: SIMPLE_PINHOLE, ", "`qnerf capture`"),
        ("FULL_OPENCV 16 12 8 8 8 6 0 0 0 0 0.1 0 0 0", "distortion k3=0.1 is not supported", "`qnerf capture`"),
        ("PINHOLE 16 12 8 8 8", "damaged"),
        ("PINHOLE 16 12 8 8 8 x", "damaged"),
        ("PINHOLE 16 12 8 8 8 6\n7 PINHOLE 16 12 8 8 8 6", "cameras.txt: number 7 comes twice"),
        ("PINHOLE 16 12 8 8 8 6".replace("PINHOLE", "pinhole"), "camera model pinhole is not supported"),
    ):
        (place / "cameras.txt").write_text(f"7 {model}\n")
        refused("colmap", posed, *needles)


def test_the_numbers_and_names_of_camera_models_are_colmap_s():
    for number, (name, keys) in MODELS.items():
        camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 10.0, 20, 10)
        theirs = camera.params_info.replace("fx", "fl_x").replace("fy", "fl_y").split(", ")
        theirs = ["fl_x" if key == "f" else "k1" if key == "k" else key for key in theirs]
        assert (camera.model.name, theirs) == (name, keys.split())


def test_a_model_that_pycolmap_wrote(tmp_path):
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=4, num_points3D=20)
    model = pycolmap.synthesize_dataset(options)
    for number, image in model.images.items():
        image.name = f"{number} ü.png"
    for kind in ("binary", "text"):
        (tmp_path / kind).mkdir()
        getattr(model, f"write_{kind}")(str(tmp_path / kind))
        frames = read_model(tmp_path / kind)["frames"]
        assert len(frames) == 4
        for frame in frames:
            image = model.find_image_with_name(frame["file_path"])
            expected = image.cam_from_world().inverse().matrix() @ np.diag([1.0, -1, -1, 1])
            np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3], expected, atol=1e-9)


def test_a_text_model_without_lines_of_points_is_refused_with_what_to_do(posed):
    place = write_text(posed)
    text = (place / "images.txt").read_text()
    records = [line for line in text.splitlines() if line.endswith(".png")]
    (place / "images.txt").write_text("\n".join(records))
    message = refused("colmap", posed, "image '000.png' must be followed by the line of its points")
    assert message.endswith("where an image has none, write an empty line after it")
    (place / "images.txt").write_text("".join(f"{record}\n\n" for record in records))
    assert len(build("colmap", posed).names) == VIEWS
    (place / "images.txt").write_text("\n\n".join(records))
    told = build("colmap", posed).description()
    assert told.startswith("8 views")
    assert "images.txt ends before the line of points of '008.png', which is left out as in COLMAP" in told
    (place / "images.txt").write_text(text.replace(" 7 00", " 8 00", 1))
    refused("colmap", posed, "image '000.png' has camera 8, which cameras.txt lacks")
    (place / "images.txt").write_text(text.replace("\n2 ", "\n1 ", 1))
    refused("colmap", posed, "images.txt: number 1 comes twice")
    for record in ("1 1 0 0 0 0 0 1 7", "1 1 0 0 0 7 a.png", "1 nan 0 0 0 0 0 1 7 a.png", "x 1 0 0 0 0 0 1 7 a.png"):
        (place / "images.txt").write_text(f"{record}\n\n")
        refused("colmap", posed, "damaged or cut short" if "nan" not in record else "no rotation")


def test_names_with_spaces_and_files_left_over_from_another_model(posed):
    place = write_text(posed)
    (posed / "images" / "003.png").rename(posed / "images" / "0 3.png")
    (place / "images.txt").write_text((place / "images.txt").read_text().replace("003.png", "0 3.png  "))
    (place / "points3D.txt").touch()
    (place / "cameras.bin").write_bytes(b"left over")
    (place / "images.bin").write_bytes(b"left over")
    assert "images/0 3.png" in build("colmap", posed).names
    (place / "points3D.bin").write_bytes(b"\0" * 8)  # now the binary model is complete, and COLMAP reads it
    refused("colmap", posed, "damaged or cut short")


@pytest.mark.parametrize(
    "places", [("sparse/0", "sparse/1"), ("colmap/sparse/0", "colmap/sparse/2"), ("sparse/3", "sparse/1")]
)
def test_of_several_models_the_largest_is_read(posed, places):
    small, large = places
    write_text(posed, nested=large)
    shutil.copytree(posed / large, posed / small)
    lines = (posed / small / "images.txt").read_text().split("\n")
    (posed / small / "images.txt").write_text("\n".join(lines[:9]) + "\n")
    scene = build("colmap", posed)
    assert len(scene.cameras) == VIEWS
    told = sorted([f"{small} poses 4", f"{large} poses {VIEWS}"])
    assert f"of several models the largest is read: {', '.join(told)}" in scene.description()
    assert len(build("colmap", posed, model=small).cameras) == 4
    (posed / small / "cameras.txt").write_text("damaged")
    assert len(build("colmap", posed).cameras) == VIEWS


def test_damaged_models_are_one_line(posed):
    place = write_binary(posed)
    for name in ("images.bin", "cameras.bin"):
        whole = (place / name).read_bytes()
        for length in (0, 5, 30, len(whole) // 2):
            (place / name).write_bytes(whole[:length])
            refused("colmap", posed, "damaged or cut short")
        (place / name).write_bytes(whole)
    (place / "images.bin").write_bytes(struct.pack("<Q", 0))
    refused("colmap", posed, "images.bin: no image is posed")
    with pytest.raises(ValueError, match="no rotation"):
        camera_to_world(0, 0, 0, 0, 1, 2, 3)


def test_llff_takes_its_lens_from_the_model_beside_it(posed):
    place = write_text(posed)
    write_llff(posed, from_text=place)
    for camera, told in (
        ("OPENCV 16 12 8 8 9 5 0.1 0.01 0.002 0.003", "distortion and principal point from sparse/0"),
        ("OPENCV 32 24 16 16 18 10 0.1 0.01 0.002 0.003", "distortion and principal point from sparse/0"),
        ("OPENCV 16 12 9 9 9 5 0.1 0.01 0.002 0.003", "lenses of sparse/0 not used: focal lengths are 1.12 times"),
    ):
        (place / "cameras.txt").write_text(f"7 {camera}\n")
        scene = build("llff", posed)
        used = told.startswith("distortion")
        assert scene.cameras.intrinsics[2].tolist() == (
            [8, 8, 9, 5, 0.1, 0.01, 0.002, 0.003] if used else [8, 8, 8, 6] + [0] * 4
        )
        assert told in scene.description()
    (place / "images.txt").write_text((place / "images.txt").read_text().replace("004.png", "4.png"))
    assert "lenses of sparse/0 not used: it lacks 'images/004.png'" in build("llff", posed).description()
    (place / "images.txt").write_text("1 1 0 0 0\n\n")
    (posed / "images" / "._000.png").touch()  # as some systems leave behind
    told = build("llff", posed).description()
    assert "lenses of sparse/0 not used: " in told
    assert "damaged" in told


def test_llff_refuses_bad_folders_in_one_line(posed):
    write_text(posed)
    write_llff(posed, from_text=posed / "sparse/0")
    (posed / "images" / "000.png").unlink()
    refused(
        "llff", posed, "poses_bounds.npy has 9 poses, but ", "images has 8 images; it has sparse/0/images.txt: use "
    )
    build("colmap", posed, skip_missing=True)
    np.save(posed / "poses_bounds.npy", np.zeros((9, 3)))
    refused("llff", posed, "expected an array of V x 17 numbers")
    (posed / "poses_bounds.npy").write_bytes(b"hello")
    refused("llff", posed, "is no array that NumPy can read")


def test_a_folder_without_the_file_is_told_what_it_holds(tmp_path):
    """What it advises is then read, or gets as far as the file."""
    for number, (file, hint) in enumerate(
        (
            ("transforms.json", "scene=nerfstudio"),
            ("transforms_train.json", "scene=blender"),
            ("poses_bounds.npy", "scene=llff"),
            ("sparse/0/images.bin", "it has sparse/0/images.bin: use scene=colmap"),
            ("images/0.JPG", "it has 1 images without poses: `qnerf capture "),
            ("walk.mp4", "it has a video: `qnerf capture "),
            ("dense/0/sparse/images.txt", "a folder in it is a scene: use scene=colmap scene.path='"),
        )
    ):
        folder = tmp_path / f"a folder {number}"
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
        for kind in ("nerfstudio", "llff", "colmap", "blender"):
            if f"scene={kind}" in hint and "scene.path" not in hint:
                assert "use scene=" not in refused(kind, folder)
            else:
                refused(kind, folder, hint, "'" if "capture" in hint else "")
        if file == "walk.mp4":
            refused("nerfstudio", folder / file, "is a video; `qnerf capture ")
