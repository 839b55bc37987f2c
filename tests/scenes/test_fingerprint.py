"""A scene's fingerprint: of what its files say, the same on every machine."""

import json
import os
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from qnerf.scenes import SCENES
from tests.helpers import scenes

# Rotations by quarter turns: no machine rounds them.
POSES = (
    [[1, 0, 0, 2.5], [0, 0, -1, -3], [0, 1, 0, 0.1], [0, 0, 0, 1]],
    [[0, 0, 1, 4], [1, 0, 0, 0.3], [0, 1, 0, 0.25], [0, 0, 0, 1]],
    [[-1, 0, 0, 0], [0, 0, 1, 3], [0, 1, 0, 0.75], [0, 0, 0, 1]],
    [[0, 0, -1, -4.125], [-1, 0, 0, 0], [0, 1, 0, 1e-3], [0, 0, 0, 1]],
)
PRINT = "import sys; from qnerf.scenes import SCENES; print(SCENES.build('nerfstudio', path=sys.argv[1]).fingerprint)"


def write(folder, poses=POSES):
    (folder / "images").mkdir(parents=True)
    frames = []
    for view, pose in enumerate(poses):
        (folder / "images" / f"{view}.ppm").write_bytes(b"P6 3 2 255 " + bytes(range(view, view + 18)))
        frames.append({"file_path": f"images/{view}.ppm", "transform_matrix": pose})
    content = {"fl_x": 4.5, "fl_y": 4.25, "k1": 0.01, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path / "scene")


build = partial(scenes.build, "nerfstudio")


def edited(folder, edit):
    """The fingerprint after an edit of transforms.json, which is put back."""
    file = folder / "transforms.json"
    before = file.read_text()
    scenes.change(folder, edit)
    found = build(folder).fingerprint
    file.write_text(before)
    return found


def test_golden_fingerprints(folder):
    scene = build(folder)
    assert scene.fingerprint == "516f68d8eeb31f69483e"
    assert SCENES.build("poster").fingerprint == "4ca3e7e22f3541c06d32"


def test_fingerprint_depends_on_what_decides_the_numbers(folder):
    one = build(folder).fingerprint
    seen = {
        one,
        edited(folder, lambda t: t.update(fl_x=np.nextafter(4.5, 5))),
        edited(folder, lambda t: t.pop("fl_y")),
        edited(folder, lambda t: t["frames"][1].update(k1=0.0)),
        edited(folder, lambda t: t["frames"][2]["transform_matrix"][0].__setitem__(0, -1 + 1e-15)),
        edited(folder, lambda t: t["frames"][3]["transform_matrix"][2].__setitem__(3, np.nextafter(1e-3, 1))),
        edited(folder, lambda t: t.update(test_filenames=["images/0.ppm"])),
        # A frame that is not used still orients the world.
        edited(folder, lambda t: t.update(train_filenames=["images/1.ppm"], test_filenames=["images/2.ppm"])),
        build(folder, width=2).fingerprint,
    }
    unused = {"train_filenames": ["images/1.ppm"], "test_filenames": ["images/2.ppm"]}
    seen.add(edited(folder, lambda t: (t.update(unused), t["frames"][0]["transform_matrix"][0].__setitem__(3, 2.75))))
    (folder / "images" / "1.ppm").rename(folder / "images" / "1b.ppm")
    seen.add(edited(folder, lambda t: t["frames"][1].update(file_path="images/1b.ppm")))
    assert len(seen) == 11


def test_fingerprint_does_not_depend_on_how_the_file_is_written(folder):
    def spell(content):
        for frame in content["frames"]:
            frame.update(k1=content["k1"], k2=0, fl_x=4.5, fl_y=4.25, file_path="./" + frame["file_path"])
            frame["transform_matrix"] = [[float(x) for x in row] for row in frame["transform_matrix"][:3]]
        content.update(k1=0.5, note="x")
        content["frames"].reverse()

    assert edited(folder, spell) == build(folder).fingerprint


def test_fingerprint_is_equal_on_every_processor_and_number_of_threads(tmp_path):
    """Of a scene whose rotations no machine stores exactly."""
    turns = Rotation.random(12, random_state=0).as_matrix().round(6)
    centres = np.random.default_rng(0).normal(size=(12, 3)).round(6)
    folder = write(tmp_path / "rounded", np.concatenate([turns, centres[..., None]], axis=2).tolist())
    names = {"OPENBLAS_CORETYPE": "Prescott", "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    command = [sys.executable, "-c", PRINT, str(folder)]
    found = subprocess.run(command, env={**os.environ, **names}, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == build(folder).fingerprint
