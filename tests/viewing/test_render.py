"""`qnerf render`: frames against the evaluator's, files in each format, mistakes."""

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from qnerf.cli import main
from qnerf.cli.commands import render
from qnerf.geometry.camera_paths import PATHS, Camera
from qnerf.training import forecast
from qnerf.training.evaluation import Evaluator
from qnerf.viewing import video
from qnerf.viewing.frames import Renderer


def pictures(count=4, width=6, height=4):
    for number in range(count):
        yield np.full((height, width, 3), 40 * number, np.uint8)


def test_a_frame_from_a_held_out_camera_is_the_evaluator_s(trained):
    renderer, view = Renderer(trained), trained.scene.eval[0]
    pose = trained.scene.cameras.poses[view].numpy()
    evaluator = Evaluator(
        trained.scene, renderer.table, trained.model,
        background=trained.settings.render.background, chunk=17, watch=renderer.watch,
    )  # fmt: skip
    theirs, mine = evaluator.render(view, trained.step), renderer.frame(Camera(pose, 8.0, 12, 8))
    torch.testing.assert_close(mine.color, theirs.color)
    torch.testing.assert_close(mine.depth, theirs.depth)


def test_videos_and_folders_hold_all_frames(tmp_path):
    for name in ("a.webp", "frames"):
        video.check(tmp_path / name, 6, 4, 4)
        video.write(tmp_path / name, pictures(), 10)
    with Image.open(tmp_path / "a.webp") as image:
        assert (image.n_frames, image.size) == (4, (6, 4))
        image.seek(3)
        assert abs(int(np.asarray(image.convert("RGB")).mean()) - 120) < 4
        assert image.info["duration"] == 100
    files = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in files] == [f"{number:05}.png" for number in range(4)]
    assert np.array_equal(np.asarray(Image.open(files[2])), list(pictures())[2])


def test_an_mp4_holds_all_frames(tmp_path):
    video.check(tmp_path / "a.mp4", 6, 4, 4)
    video.write(tmp_path / "a.mp4", pictures(), 10)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert (frames, seconds) == (4, pytest.approx(0.4))


def test_sizes_that_a_format_cannot_hold_are_refused(tmp_path):
    with pytest.raises(ValueError, match="an even width and height, got 3 x 4"):
        video.check(tmp_path / "a.mp4", 3, 4, 1)
    with pytest.raises(ValueError, match="at most 16,383 pixels a side"):
        video.check(tmp_path / "a.webp", 16_384, 4, 1)


@pytest.mark.parametrize("name", ["a.webp", "a.mp4", "frames"])
def test_a_rendering_that_fails_leaves_nothing(tmp_path, name):

    def failing():
        yield from pictures(2)
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        video.write(tmp_path / name, failing(), 10)
    assert list(tmp_path.iterdir()) == []


def test_render_writes_videos_of_colour_and_depth(tiny_run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for what in ("color", "depth"):
        arguments = [str(tiny_run), "--path", "orbit", "--size", "10x6", "--frames", "2", "--what", what]
        assert main.dispatch("render", arguments) == 0
    assert "2 frames of 10 x 6, 0.1 s of video, step 3" in capsys.readouterr().out
    (color, depth) = sorted((tmp_path / "renders").iterdir())
    assert (color.name, depth.name) == (f"{tiny_run.name}-orbit-depth.webp", f"{tiny_run.name}-orbit.webp")
    with Image.open(color) as one, Image.open(depth) as other:
        assert one.n_frames == other.n_frames == 2
        assert not np.array_equal(np.asarray(one.convert("RGB")), np.asarray(other.convert("RGB")))


def test_long_work_is_announced_and_refused_from_a_day_on(tiny_run, tmp_path, capsys, monkeypatch):
    jobs = {
        "render": ["--size", "10x6", "--frames", "2", "--out", str(tmp_path / "video.webp")],
        "export": ["--within", "900", "--out", str(tmp_path / "points.ply")],
    }
    for name, arguments in jobs.items():
        monkeypatch.setattr(forecast, "TELL", 0.0)
        assert main.dispatch(name, [str(tiny_run), *arguments]) == 0
        assert ": about 0 minutes; --" in capsys.readouterr().out
        (written,) = tmp_path.iterdir()
        written.unlink()
        monkeypatch.setattr(Evaluator, "seconds", lambda *_: 1e5)
        assert main.dispatch(name, [str(tiny_run), *arguments]) in (1, 2)
        assert "or run.hours=56 goes on" in capsys.readouterr().err
        assert not list(tmp_path.iterdir())
        assert main.dispatch(name, [str(tiny_run), *arguments, "run.hours=56"]) == 0
        written.unlink()
        monkeypatch.undo()


def test_render_refuses_mistakes_in_one_line_and_writes_nothing(tiny_run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for line, message in {
        "--out a.gif": "expected a name that ends in .webp or .mp4",
    }.items():
        assert main.dispatch("render", [str(tiny_run), *line.split()]) == 2
        err = capsys.readouterr().err
        assert (message in err, err.count("\n")) == (True, 1)
    assert list(tmp_path.iterdir()) == []


def test_render_knows_every_path():
    assert set(render.NAMES) == set(PATHS)


def test_a_run_without_a_checkpoint_is_one_line(tiny_run, tmp_path, capsys):
    bare = tmp_path / "runs" / tiny_run.name
    bare.mkdir(parents=True)
    (bare / "config.yaml").write_bytes((tiny_run / "config.yaml").read_bytes())
    assert main.dispatch("render", [str(bare)]) == 2
    assert "this run is interrupted and has no checkpoint" in capsys.readouterr().err
