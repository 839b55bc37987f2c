"""The synthetic-NeRF layout."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
import torch

from tests.helpers import scenes
from tests.helpers.scenes import change, write_scene

build, refused = partial(scenes.build, "blender"), partial(scenes.refused, "blender")


@pytest.fixture
def folder(tmp_path):
    """Ten views: five train, three test, two val."""
    folder = write_scene(tmp_path / "scene", views=10, width=8, height=8, channels=4)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    (folder / "transforms.json").unlink()
    for split, part in (("train", frames[:5]), ("test", frames[5:8]), ("val", frames[8:])):
        named = [dict(frame, file_path=f"./{frame['file_path'][:-4]}", rotation=0.1) for frame in part]
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": named}))
    return folder


def test_the_splits_are_the_files(folder):
    scene = build(folder)
    assert scene.images.shape == (8, 8, 8, 4)
    assert (scene.train, scene.eval) == ([0, 1, 2, 3, 4], [5, 6, 7])
    assert scene.names[5] == "images/005.png"
    scene = build(folder, eval_split="val")
    assert [scene.names[view] for view in scene.eval] == ["images/008.png", "images/009.png"]


def test_the_world_is_only_scaled_and_bounds_with_it(folder):
    scene = build(folder)
    source = json.loads((folder / "transforms_train.json").read_text())["frames"][3]["transform_matrix"]
    scale = float(scene.transform[0, 0])
    assert float(scene.cameras.poses[:, :, 3].abs().max()) == pytest.approx(1)
    np.testing.assert_allclose(scene.cameras.poses[3, :, :3], np.array(source)[:3, :3], atol=1e-12)
    np.testing.assert_allclose(scene.cameras.poses[3, :, 3], np.array(source)[:3, 3] * scale)
    assert (scene.near, scene.far) == (pytest.approx(2 * scale), pytest.approx(6 * scale))
    assert float(scene.cameras.fx[0]) == float(scene.cameras.fy[0]) == pytest.approx(4 / np.tan(0.35))
    assert float(scene.cameras.cx[0]) == 4


def test_an_even_subset_evaluates_in_the_same_world(folder):
    scene, one = build(folder), build(folder, eval_views=1)
    assert one.images.shape[0] == 6
    assert [one.names[view] for view in one.eval] == ["images/006.png"]
    assert torch.equal(one.transform, scene.transform)
    assert torch.equal(one.images[5], scene.images[6])
    assert one.fingerprint != scene.fingerprint
    assert build(folder, eval_views=99).fingerprint == scene.fingerprint


def test_blender_without_a_split_holds_out_some_training_views(folder):
    for view in (5, 6, 7):  # poses without images, as of a benchmark
        (folder / "images" / f"{view:03d}.png").unlink()
    scene = build(folder)
    assert [scene.names[view] for view in scene.eval] == ["images/008.png", "images/009.png"]
    assert "transforms_val.json is held out: transforms_test.json has no images" in scene.description()
    for view in (8, 9):
        (folder / "images" / f"{view:03d}.png").unlink()
    for skip in (False, True):
        scene = build(folder, skip_missing=skip)
        assert (scene.train, scene.eval) == ([0, 1, 2, 4], [3])
        told = "one in ten views of transforms_train.json is held out: no other split has images"
        assert told in scene.description()
    for split in ("test", "val"):
        (folder / f"transforms_{split}.json").unlink()
    assert build(folder).fingerprint == scene.fingerprint
    (folder / "transforms_train.json").rename(folder / "transforms_val.json")
    scene = build(folder)
    assert (scene.train, scene.eval) == ([0, 1, 2, 4], [3])
    assert "one in ten views of transforms_val.json is held out" in scene.description()


def test_blender_refuses_bad_options_and_files(folder, tmp_path):
    refused(folder, "eval_split expects one of test, val", eval_split="train")
    refused(folder, "eval_views must be between 1 and", eval_views=0)
    refused(tmp_path / "none", "does not exist")
    (folder / "images" / "006.png").unlink()
    refused(folder, "1 of 8 images are missing", "'./images/006'", "skip_missing=true goes on with the other 7")
    assert len(build(folder, skip_missing=True).eval) == 2
    train = folder / "transforms_train.json"
    shutil.copy(train, folder / "transforms_test.json")
    refused(folder, "training and in the evaluation split")
    (folder / "other.png").symlink_to(folder / "images" / "000.png")
    change(folder, lambda t: t.update(frames=[t["frames"][0] | {"file_path": "other.png"}]), "transforms_test.json")
    refused(folder, "training and in the evaluation split")
    train.rename(folder / "transforms.json")
    for split in ("test", "val"):
        (folder / f"transforms_{split}.json").unlink()
    message = refused(folder, "no transforms_train.json", "it has transforms.json: use scene=nerfstudio")
    assert "scene=blender;" not in message
    scenes.build("nerfstudio", folder)
