"""A scene's folder from elsewhere: its files lead nowhere outside, and its numbers are refused by name."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qnerf.cli.errors import MAX_MESSAGE, one_line
from qnerf.scenes import SCENES, transforms
from tests.helpers.scenes import write_scene

Build = Callable[[], Any]


def blender_folder(folder: Path) -> Path:
    """The same views as `write_scene`, as the synthetic-NeRF layout has them."""
    content = json.loads((write_scene(folder) / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    for split, frames in (("train", content["frames"][:4]), ("test", content["frames"][4:])):
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return folder


@pytest.fixture(params=["nerfstudio", "blender"])
def scene(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, Path, Build]:
    """Folder, transforms file, and a function that builds the scene."""
    nerfstudio = request.param == "nerfstudio"
    folder = (write_scene if nerfstudio else blender_folder)(tmp_path / "scene")
    file = folder / ("transforms.json" if nerfstudio else "transforms_train.json")
    return folder, file, lambda: SCENES.build(request.param, path=str(folder))


def refused(build: Build, *needles: str) -> None:
    with pytest.raises(ValueError) as error:  # noqa: PT011
        build()
    assert "\n" not in str(error.value)
    for needle in needles:
        assert needle in str(error.value)


def change(file: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    "name",
    ["../secret.png", "../secret", "/etc/passwd", "//etc/passwd", "images/../../secret.png",
     "images/../../scene/../secret", "./../secret.png", "link.png", "link", "folder/secret.png", "chain.png", "..",
     "images/../.."],
)  # fmt: skip
def test_what_leads_out_of_the_folder(scene: tuple[Path, Path, Build], name: str) -> None:
    folder, file, build = scene
    secret = folder.parent / "secret.png"
    shutil.copy(folder / "images" / "000.png", secret)
    (folder / "link.png").symlink_to(secret)
    (folder / "folder").symlink_to(folder.parent)
    (folder / "chain.png").symlink_to("link.png")
    change(file, lambda content: content["frames"][1].update(file_path=name))
    refused(build, repr(name), "outside the scene's folder")


@pytest.mark.parametrize("name", ["loop.png", "images", "pipe.png", "images/\0.png", "x" * 5000, "null.png"])
def test_what_is_no_file(scene: tuple[Path, Path, Build], name: str) -> None:
    folder, file, build = scene
    (folder / "loop.png").symlink_to("loop.png")
    os.mkfifo(folder / "pipe.png")
    (folder / "null.png").symlink_to("/dev/null")
    change(file, lambda content: content["frames"][1].update(file_path=name))
    refused(build, repr(name))


@pytest.mark.parametrize(
    "value", [float("nan"), float("inf"), -float("inf"), 1e300, 1e-300, 1e-4, -1, 0, 10**400, "8", [8], {"a": 8}, True]
)
@pytest.mark.parametrize("key", ["fl_x", "fl_y", "w", "h"])
def test_sizes_and_focal_lengths(scene: tuple[Path, Path, Build], key: str, value: Any) -> None:
    _, file, build = scene
    change(file, lambda content: content["frames"][1].update({key: value}))
    refused(build, "'images/001.png'", key)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e13, "8", [8], True])
@pytest.mark.parametrize("key", ["cx", "cy", "k1", "k2", "p1", "p2", "k3", "camera_angle_x"])
def test_the_lens(scene: tuple[Path, Path, Build], key: str, value: Any) -> None:
    _, file, build = scene
    change(file, lambda content: content["frames"][1].update({key: value}))
    refused(build, "'images/001.png'", key)


@pytest.mark.parametrize(
    "matrix",
    [
        np.full((4, 4), np.nan).tolist(),
        np.full((4, 4), 1e300).tolist(),
        [[10**400] * 4] * 4,
        [[[]]],
        [["__import__('os').system('true')"] * 4] * 4,
        {"a": 1},
        [[None] * 4] * 4,
        [["1.0", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[1, 0, 0, 0], [0, True, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, False, 1]],
        [[1, 0, 0, [0]], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[1, 0, 0, 0, 0], [0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        np.zeros((300, 300)).tolist(),
    ],
    ids=[
        "nan",
        "large",
        "larger",
        "empty",
        "text",
        "object",
        "null",
        "number as text",
        "true",
        "false",
        "list",
        "ragged",
        "shape",
    ],
)
def test_poses(scene: tuple[Path, Path, Build], matrix: Any) -> None:
    _, file, build = scene
    change(file, lambda content: content["frames"][1].update(transform_matrix=matrix))
    refused(build, "'images/001.png'")


@pytest.mark.parametrize("value", [1e-300, 1e-9, 3.14159265358979])
def test_angles_of_view_that_no_lens_has(scene: tuple[Path, Path, Build], value: float) -> None:
    _, file, build = scene
    change(file, lambda content: content["frames"][1].update(camera_angle_x=value))
    refused(build, "'images/001.png'", "camera_angle_x", "focal length")


@pytest.mark.parametrize("way", ["suffix", "link", "hard link", "folder"])
def test_one_image_under_two_names(scene: tuple[Path, Path, Build], way: str) -> None:
    folder, file, build = scene
    other = {"suffix": "images/000", "folder": "also/000.png"}.get(way, "other.png")
    if way == "link":
        (folder / other).symlink_to(Path("images", "000.png"))
    elif way == "hard link":
        os.link(folder / "images" / "000.png", folder / other)
    elif way == "folder":
        (folder / "also").symlink_to("images")
    change(file, lambda content: content["frames"][2].update(file_path=other))
    refused(build, str(file), "one image file twice", "'images/000.png'", repr(other))


@pytest.mark.parametrize("name", ["images/000", "other.png"])
def test_one_image_in_two_splits(tmp_path: Path, name: str) -> None:
    folder = blender_folder(tmp_path / "scene")
    (folder / "other.png").symlink_to(Path("images", "000.png"))
    change(folder / "transforms_test.json", lambda content: content["frames"][1].update(file_path=name))
    refused(lambda: SCENES.build("blender", path=str(folder)), "training and in the evaluation split")


@pytest.mark.parametrize(
    "text",
    ["[" * 200_000, '{"frames": ' + "[" * 200_000, '{"a":' * 100_000, '{"frames": [' + "9" * 5000 + "]}", "\x1b[2J"],
    ids=["lists", "frames", "objects", "digits", "escape"],
)
def test_json_that_is_too_much(scene: tuple[Path, Path, Build], text: str) -> None:
    _, file, build = scene
    file.write_text(text)
    refused(build, str(file))


def test_a_giant_file_is_not_read(scene: tuple[Path, Path, Build]) -> None:
    _, file, build = scene
    with open(file, "r+b") as stream:
        stream.truncate(2**40)  # a hole: it takes no room on the disk, but would in memory
    refused(build, str(file), "expected at most 256 MiB, got")
    assert transforms.MAX_JSON_BYTES == 2**28


@pytest.mark.parametrize("value", [False, 0, "", {}])
@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("camera_model", "camera model"),
        ("train_filenames", "train_filenames must be a list of file names"),
        ("test_filenames", "test_filenames must be a list of file names"),
    ],
)
def test_a_wrong_type_is_not_taken_for_nothing(tmp_path: Path, key: str, label: str, value: object) -> None:
    file = write_scene(tmp_path / "scene") / "transforms.json"
    change(file, lambda content: content.update({key: value}))
    refused(lambda: SCENES.build("nerfstudio", path=file.parent), label)


def test_a_message_is_never_long(tmp_path: Path) -> None:
    file = write_scene(tmp_path / "scene") / "transforms.json"
    change(file, lambda content: content["frames"][0].update(file_path="x" * 10**6))
    with pytest.raises(ValueError, match="missing") as error:
        SCENES.build("nerfstudio", path=file.parent)
    assert len(one_line(error.value)) == MAX_MESSAGE
