"""COLMAP models and LLFF folders, and what is said where a folder holds something else."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from qnerf.scenes import SCENES, Scene
from qnerf.scenes.colmap import MODELS, camera_to_world, read_model
from tests.helpers.scenes import write_scene

VIEWS, WIDTH, HEIGHT = 9, 16, 12


@pytest.fixture
def posed(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene", VIEWS, WIDTH, HEIGHT)


def poses(folder: Path) -> list[np.ndarray]:
    """Camera-to-world 4 x 4, as the transforms file has them; the file goes."""
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    return [np.array(frame["transform_matrix"]) for frame in content["frames"]]


def world_to_camera(pose: np.ndarray) -> list[float]:
    """COLMAP's qw qx qy qz tx ty tz, from its definition."""
    matrix = np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1]))
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return [w, x, y, z, *matrix[:3, 3]]


def write_text(folder: Path, model: str = "PINHOLE 16 12 8 8 8 6", nested: str = "sparse/0") -> Path:
    place = folder / nested
    place.mkdir(parents=True)
    (place / "cameras.txt").write_text(f"# Camera list\n7 {model}\n")
    lines = ["# Image list"]
    for view, pose in enumerate(poses(folder)):
        numbers = " ".join(map(repr, map(float, world_to_camera(pose))))
        lines += [f"{view + 1} {numbers} 7 {view:03d}.png", "" if view % 2 else "1.0 2.0 -1 3.0 4.0 5"]
    (place / "images.txt").write_text("\n".join(lines) + "\n")
    return place


def write_binary(folder: Path) -> Path:
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    (place / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 7, 1, WIDTH, HEIGHT, 8, 8, 8, 6))
    data = struct.pack("<Q", VIEWS)
    for view, pose in enumerate(poses(folder)):
        data += struct.pack("<i7di", view + 1, *world_to_camera(pose), 7) + f"{view:03d}.png".encode() + b"\0"
        data += struct.pack("<Q", 1) + struct.pack("<ddq", 1.0, 2.0, -1)
    (place / "images.bin").write_bytes(data)
    return place


def write_llff(folder: Path, factor: int = 1) -> None:
    rows = []
    for pose in poses(folder):
        columns = np.stack([-pose[:3, 1], pose[:3, 0], pose[:3, 2], pose[:3, 3]], axis=1)
        size = np.array([[HEIGHT * factor], [WIDTH * factor], [8.0 * factor]])
        rows.append([*np.concatenate([columns, size], axis=1).ravel(), 0.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def build(kind: str, folder: Path, **options: Any) -> Scene:
    return SCENES.build(kind, path=str(folder), **options)


def same(one: Scene, other: Scene) -> None:
    torch.testing.assert_close(one.cameras.poses, other.cameras.poses)
    torch.testing.assert_close(one.cameras.intrinsics, other.cameras.intrinsics)
    assert torch.equal(one.images, other.images)


@pytest.mark.parametrize("write", [write_text, write_binary, write_llff])
def test_a_reconstruction_is_the_scene_that_it_was_written_from(posed: Path, write: Any) -> None:
    expected = build("nerfstudio", posed)
    write(posed)
    kind = "llff" if write is write_llff else "colmap"
    scene = build(kind, posed)
    same(scene, expected)
    assert (scene.eval, len(scene.train)) == ([0, 8], VIEWS - 2)  # every eighth, as in the papers
    assert build(kind, posed, eval_every=None).eval == expected.eval
    assert scene.fingerprint != build(kind, posed, eval_every=None).fingerprint
    small = build(kind, posed, width=8)
    assert (small.cameras.width, small.cameras.height) == (8, 6)


def test_smaller_images_stand_in(posed: Path) -> None:
    expected = build("nerfstudio", posed)
    write_llff(posed, factor=4)
    (posed / "images").rename(posed / "images_4")
    same(build("llff", posed), expected)
    same(build("llff", posed, images="images_4"), expected)


def test_photographs_may_lie_in_the_scene_s_folder_itself(posed: Path) -> None:
    expected = build("nerfstudio", posed)
    write_text(posed, nested="colmap/sparse/0")
    for file in list((posed / "images").iterdir()):
        file.rename(posed / file.name)
    same(build("colmap", posed), expected)
    (posed / "003.png").unlink()
    with pytest.raises(ValueError, match=r"1 of 9 images are missing, the first is 'images/003.png'"):
        build("colmap", posed)
    assert len(build("colmap", posed, skip_missing=True).names) == VIEWS - 1


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("SIMPLE_PINHOLE 16 12 9 8 6", [9, 9, 8, 6, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL 16 12 9 8 6 0.1", [9, 9, 8, 6, 0.1, 0, 0, 0]),
        ("RADIAL 16 12 9 8 6 0.1 0.01", [9, 9, 8, 6, 0.1, 0.01, 0, 0]),
        ("OPENCV 16 12 9 8 8 6 0.1 0.01 0.002 0.003", [9, 8, 8, 6, 0.1, 0.01, 0.002, 0.003]),
        ("FULL_OPENCV 16 12 9 8 8 6 0.1 0 0 0 0 0 0 0", [9, 8, 8, 6, 0.1, 0, 0, 0]),
        ("OPENCV_FISHEYE 16 12 9 8 8 6 0.1 0.01 0.002 0.003", [9, 8, 8, 6, 0.1, 0.01, 0.002, 0.003]),
        ("RADIAL_FISHEYE 16 12 9 8 6 0.1 0.01", [9, 9, 8, 6, 0.1, 0.01, 0, 0]),
    ],
)
def test_camera_models(posed: Path, model: str, lens: list[float]) -> None:
    write_text(posed, model)
    cameras = build("colmap", posed).cameras
    assert cameras.intrinsics[3].tolist() == lens
    assert (cameras.fisheye is not None) is ("FISHEYE" in model)


def test_the_numbers_and_names_of_camera_models_are_colmap_s() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    for number, (name, keys) in MODELS.items():
        camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 10.0, 20, 10)
        theirs = camera.params_info.replace("fx", "fl_x").replace("fy", "fl_y").split(", ")
        theirs = ["fl_x" if key == "f" else "k1" if key == "k" else key for key in theirs]
        assert (camera.model.name, theirs) == (name, keys.split())


def test_a_model_that_pycolmap_wrote(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is not installed")
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=4, num_points3D=20)
    model = pycolmap.synthesize_dataset(options)
    for kind in ("binary", "text"):
        (tmp_path / kind).mkdir()
        getattr(model, f"write_{kind}")(str(tmp_path / kind))
        frames = read_model(tmp_path / kind)["frames"]
        assert len(frames) == 4
        for frame in frames:
            image = model.find_image_with_name(frame["file_path"])
            expected = image.cam_from_world().inverse().matrix() @ np.diag([1.0, -1, -1, 1])
            np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("FOV 16 12 8 8 8 6 0.1", "camera model FOV is not supported; known: SIMPLE_PINHOLE, .*`qnerf capture`"),
        ("FULL_OPENCV 16 12 8 8 8 6 0 0 0 0 0.1 0 0 0", "distortion k3=0.1 is not supported.*`qnerf capture`"),
        ("PINHOLE 16 12 8 8 8", "damaged"),
        ("PINHOLE 16 12 8 8 8 x", "damaged"),
    ],
)
def test_bad_cameras_are_one_line(posed: Path, model: str, message: str) -> None:
    write_text(posed, model)
    with pytest.raises(ValueError, match=message) as error:
        build("colmap", posed)
    assert "\n" not in str(error.value)


def test_damaged_models_are_one_line(posed: Path) -> None:
    place = write_binary(posed)
    for name in ("images.bin", "cameras.bin"):
        whole = (place / name).read_bytes()
        for length in (0, 5, 30, len(whole) // 2):
            (place / name).write_bytes(whole[:length])
            with pytest.raises(ValueError, match="damaged or cut short"):
                build("colmap", posed)
        (place / name).write_bytes(whole)
    with pytest.raises(ValueError, match="which is no rotation"):
        camera_to_world(0, 0, 0, 0, 1, 2, 3)


def test_bad_llff_folders_are_one_line(posed: Path) -> None:
    write_llff(posed)
    (posed / "images" / "000.png").unlink()
    with pytest.raises(ValueError, match=r"poses_bounds.npy has 9 poses, but .*images has 8 images"):
        build("llff", posed)
    np.save(posed / "poses_bounds.npy", np.zeros((9, 3)))
    with pytest.raises(ValueError, match="expected an array of V x 17 numbers"):
        build("llff", posed)
    (posed / "poses_bounds.npy").write_bytes(b"hello")
    with pytest.raises(ValueError, match="is no array that NumPy can read"):
        build("llff", posed)


@pytest.mark.parametrize(
    ("file", "hint"),
    [
        ("transforms.json", "scene=nerfstudio"),
        ("transforms_train.json", "scene=blender"),
        ("poses_bounds.npy", "scene=llff"),
        ("sparse/0/cameras.bin", "it has a COLMAP model in sparse/0: use scene=colmap"),
        ("images/0.JPG", "it has 1 images without poses: `qnerf capture .*images --out DIR` finds the poses"),
        ("walk.mp4", "it has a video: `qnerf capture .*walk.mp4 --out DIR`"),
        ("notes.txt", "expected|has no"),
    ],
)
def test_a_folder_without_the_file_is_told_what_it_holds(tmp_path: Path, file: str, hint: str) -> None:
    place = tmp_path / file
    place.parent.mkdir(parents=True, exist_ok=True)
    place.touch()
    if place.name == "cameras.bin":
        (place.parent / "images.bin").touch()
    for kind in ("nerfstudio", "llff", "colmap"):
        if f"scene={kind}" not in hint:
            with pytest.raises(ValueError, match=hint):
                build(kind, tmp_path)
