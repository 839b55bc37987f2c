"""`qnerf capture`: what it refuses, what it leaves behind, and that it finds the poses of a scene that is known."""

import json
import multiprocessing
import shlex
import shutil
import signal

import imageio_ffmpeg as ffmpeg
import numpy as np
import pytest
from PIL import Image

from qnerf.capture.photographs import capture, transforms
from qnerf.capture.video import extract_frames, sharpness
from qnerf.cli import main
from qnerf.scenes import SCENES, folders
from tests.helpers import processes, worlds
from tests.helpers.configs import composed


def write(folder, *images):
    folder.mkdir()
    for number, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{number:02d}.png")
    return folder


def wall(views=4):
    return [np.full((60, 80, 3), 200, np.uint8)] * views


def unlike(views=3):
    random = np.random.default_rng(0)
    return [np.kron(random.integers(0, 255, (30, 40, 3), np.uint8), np.ones((4, 4, 1), np.uint8)) for _ in range(views)]


def above_a_floor(turning=False):
    """Cameras above a textured floor and around it, and their photographs (120, 160, 3); turning: all in one place."""
    angles = np.linspace(0, 1.2, 7)
    centres = [
        (0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.8 + 0.1 * (number % 3)) for number, angle in enumerate(angles)
    ]
    poses = [worlds.look_at(centre, np.zeros(3)) for centre in centres]
    if turning:
        poses = [worlds.look_at((0.3, 0.0, 0.8), np.array([0, 0.4 * number / 7, 0])) for number in range(7)]
    of = worlds.cameras(np.stack(poses), 160, 120, 150.0)
    images = []
    for view in range(len(of)):
        origins, directions = worlds.pixel_rays(of, view)
        hit = (origins - directions * (origins[..., 2:] / directions[..., 2:])).numpy()
        bump = worlds.texture(hit[..., 0], hit[..., 1], 30.0)
        images.append(np.repeat((255 * bump).round().astype(np.uint8)[..., None], 3, axis=2))
    return of, images


def test_photographs_that_cannot_be_posed_are_one_line_and_leave_nothing(tmp_path):
    turning = above_a_floor(turning=True)[1]
    cases = [
        (wall(), "auto", "0 of 4 photographs have 40 features or more, 3 are needed"),
        (unlike(), "auto", "no two photographs show the same things"),
        ([], "auto", "expected a folder of at least 3 photographs .*, got 0"),
        (turning, "auto", "fewer than 3 of 7 photographs can be found: .* the camera only turned"),
        (turning, "each", "the camera only turned, or the scene is flat: .* \\(--lens shared\\)"),
    ]
    for images, lens, message in cases:
        source = write(tmp_path / "images", *images)
        with pytest.raises(ValueError, match=message) as error:
            capture(source, tmp_path / "out", lens=lens)
        assert "\n" not in str(error.value)
        assert list(tmp_path.iterdir()) == [source]
        assert not multiprocessing.active_children()
        shutil.rmtree(source)


def test_sources_that_cannot_be_read_are_one_line(tmp_path):
    source = write(tmp_path / "images", *unlike())
    (source / "01.png").write_bytes((source / "01.png").read_bytes()[:800])
    for bad, message in (
        (source, r"01.png does not decode"),
        (tmp_path / "none", "none does not exist"),
        (source / "00.png", "00.png is no video or folder"),
    ):
        with pytest.raises(ValueError, match=message):
            capture(bad, tmp_path / "out")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "file").touch()
    with pytest.raises(ValueError, match=r"taken exists already; choose a new folder"):
        capture(source, tmp_path / "taken")
    shutil.rmtree(tmp_path / "taken")
    with pytest.raises(ValueError, match=r"00.png/out cannot be made: .*: .*00.png"):
        capture(source, source / "00.png" / "out")
    with pytest.raises(ValueError, match="frames must be between 3 and 1000000, got 0"):
        capture(source, tmp_path / "out", frames=0)
    assert list(tmp_path.iterdir()) == [source]


def test_a_video_that_does_not_decode_is_one_line(tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"no video" * 99)
    with pytest.raises(ValueError, match=r"walk.mp4 does not decode as a video: .") as error:
        capture(tmp_path / "walk.mp4", tmp_path / "out")
    assert "\n" not in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["walk.mp4"]


def test_the_sharpest_frame_of_each_part_of_a_video_is_taken(tmp_path):
    sharp = unlike(1)[0]
    blurred = np.repeat(np.repeat(sharp[8::16, 8::16], 16, axis=0), 16, axis=1)[:120, :160]
    video = ffmpeg.write_frames(str(tmp_path / "walk.mp4"), (160, 112), fps=10)
    video.send(None)
    for number in range(12):  # sharp: frames 1, 4, 7, 10
        frame = sharp if number % 3 == 1 else np.pad(blurred, ((0, 120 - blurred.shape[0]), (0, 0), (0, 0)))
        video.send(np.ascontiguousarray(frame[:112]))
    video.close()
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 4, lambda what, done, total: None)
    found = folders.photographs(tmp_path / "frames")
    assert [path.name for path in found] == ["0000.jpg", "0001.jpg", "0002.jpg", "0003.jpg"]
    assert min(sharpness(np.asarray(Image.open(path).copy())) for path in found) > 2 * sharpness(blurred)


def test_frames_at_uneven_times_are_each_taken_once(tmp_path):
    """As telephones film: three frames within a tenth of a second, then one a second."""
    times = ["-vf", "setpts=max(N/30\\,N-3)/TB", "-fps_mode", "vfr"]
    video = ffmpeg.write_frames(str(tmp_path / "walk.mp4"), (160, 112), fps=30, output_params=times)
    video.send(None)
    for image in unlike(8):
        video.send(np.ascontiguousarray(image[:112]))
    video.close()
    (tmp_path / "frames").mkdir()
    extract_frames(tmp_path / "walk.mp4", tmp_path / "frames", 100, lambda what, done, total: None)
    assert len(folders.photographs(tmp_path / "frames")) == ffmpeg.count_frames_and_secs(tmp_path / "walk.mp4")[0] == 8


def test_capture_writes_once_what_all_frames_share():
    frames = [
        {"file_path": name, "transform_matrix": [], "w": 8, "fl_x": focal} for name, focal in (("b", 2), ("a", 1))
    ]
    content = transforms({"frames": frames})
    assert content == {
        "w": 8,
        "frames": [
            {"file_path": "images/a", "transform_matrix": [], "fl_x": 1},
            {"file_path": "images/b", "transform_matrix": [], "fl_x": 2},
        ],
    }


def test_a_command_poses_a_known_scene(tmp_path, capsys):
    """One photograph shows something else, one was taken sideways."""
    of, images = above_a_floor()
    source = tmp_path / "images"
    source.mkdir()
    for view, pixels in enumerate(images):
        image = Image.fromarray(pixels)
        exif = image.getexif()
        if view == 3:
            image, exif[0x0112] = image.transpose(Image.Transpose.ROTATE_90), 6
        image.save(source / f"{view}.png", exif=exif)
    Image.fromarray(unlike(1)[0]).save(source / "9.png")
    assert main.dispatch("capture", [str(source), "--out", str(tmp_path / "my scene")]) == 0
    told = capsys.readouterr().out
    assert "pairs of photographs: 28" in told
    (command,) = (line.removeprefix("next: ") for line in told.splitlines() if line.startswith("next: "))
    assert command == f"qnerf run scene=nerfstudio 'scene.path={tmp_path}/my scene' scene.width=64"
    options = composed(*shlex.split(command)[2:])["scene"]
    assert options.pop("validation") is None
    assert SCENES.build(options.pop("name"), **options).cameras.width == 64
    assert "7 of 8 photographs were posed" in told
    assert "not posed: 9.png" in told
    scene = SCENES.build("nerfstudio", path=str(tmp_path / "my scene"))
    assert "k1" not in json.loads((tmp_path / "my scene" / "transforms.json").read_text())
    sparse = SCENES.build("colmap", path=str(tmp_path / "my scene"), points=True)
    assert set(sparse.points[:, 0].tolist()) == set(range(7))
    turns = scene.cameras.poses[:, :, :3].numpy()
    truth = of.poses[:, :, :3].numpy()
    for view in range(6):  # rotations between neighbours do not depend on the world's axes
        found, expected = (of_all[view].T @ of_all[view + 1] for of_all in (turns, truth))
        assert np.degrees(np.arccos(np.clip((np.trace(found.T @ expected) - 1) / 2, -1, 1))) < 0.5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "my scene"]


def test_two_scenes_in_one_folder_and_exposure_that_varies(tmp_path, capsys):
    """The larger group becomes the scene. The brightness of its photographs differs by up to a half."""
    images = above_a_floor()[1]
    others = [255 - image[::-1, :, ::-1] for image in images[1:5]]  # negatives have other features
    others = [np.repeat((image[..., :1] // 2 + 60), 3, axis=2) for image in others]
    varied = [(image * gain).astype(np.uint8) for image, gain in zip(images, np.linspace(0.6, 1.2, 7), strict=True)]
    source = write(tmp_path / "images", *varied, *others)
    assert main.dispatch("capture", [str(source), "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    assert "7 of 11 photographs were posed" in told
    assert "not posed: 07.png, 08.png, 09.png, 10.png" in told
    assert "2 groups that share nothing, of 7, 4; the first was taken" in told
    scene = SCENES.build("nerfstudio", path=str(tmp_path / "out"))
    assert scene.names == [f"images/{number:02d}.png" for number in range(7)]


@pytest.mark.usefixtures("signals")
def test_a_command_that_is_ended_leaves_nothing(tmp_path):
    """SIGTERM reaches the command alone, not COLMAP's process."""
    (tmp_path / "images").mkdir()
    for number, image in enumerate(unlike(8)):
        Image.fromarray(image).resize((1600, 1600)).save(tmp_path / "images" / f"{number}.png")
    process = processes.Forked("capture", str(tmp_path / "images"), "--out", str(tmp_path / "out"))
    processes.wait(lambda: list(tmp_path.glob(".out-*/log.txt")))
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=processes.PATIENCE)
    process.close()
    assert process.returncode == 130, err
    assert "Traceback" not in err
    assert [path.name for path in tmp_path.iterdir()] == ["images"]
