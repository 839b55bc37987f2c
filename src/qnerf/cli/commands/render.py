"""`qnerf render RUN --path orbit|spiral|interpolate`."""

import argparse
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import track

from qnerf.cli.commands import add_overrides, add_run
from qnerf.cli.numbers import number, whole
from qnerf.cli.text import console, count, duration
from qnerf.records import find
from qnerf.records.printable import printable

if TYPE_CHECKING:
    from qnerf.geometry.camera_paths import Camera
    from qnerf.probes import Trained
    from qnerf.viewing.frames import Renderer

NAMES = ("orbit", "spiral", "interpolate")
LONGER_SIDE = 256  # pixels
MAX_SIDE, MAX_FRAMES = 16_384, 100_000


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Renders a video of a run's model: of its last checkpoint, if the run is not finished. The name of --out "
        "decides the format: .webp, .mp4 (needs the extra view), or without an ending a folder of PNG files."
    )
    add_run(parser)
    add_overrides(parser)
    parser.add_argument(
        "--path", choices=NAMES, default="interpolate",
        help="orbit (around what the cameras look at), spiral (around one camera), or interpolate (through the "
        "training cameras; the default)",
    )  # fmt: skip
    parser.add_argument(
        "--size", type=size, metavar="WxH", help="pixels (default: as the photographs, longer side 256)"
    )
    parser.add_argument(
        "--frames", type=whole(1, MAX_FRAMES), metavar="N", default=120, help="number of pictures (default: 120)"
    )
    parser.add_argument("--fps", type=number(1, 240), default=24.0, metavar="N", help="frames a second (default: 24)")
    parser.add_argument(
        "--what", choices=("color", "depth"), default="color", help="default: %(default)s; near is bright"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="default: renders/RUN-PATH.webp")


def size(text: str) -> tuple[int, int]:
    """`128x72` -> (128, 72)."""
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if match is None or max(map(int, match.groups())) > MAX_SIDE:
        raise argparse.ArgumentTypeError(f"expected a size such as 128x72, at most {MAX_SIDE} a side, got {text!r:.60}")
    return int(match[1]), int(match[2])


def main(options: argparse.Namespace) -> None:
    run = find(options.run, options.store)

    from qnerf.cli.stored import load_stored
    from qnerf.training.forecast import announced
    from qnerf.viewing import video
    from qnerf.viewing.frames import Renderer

    out = options.out or Path("renders") / f"{run.name}-{options.path}{'-depth' * (options.what == 'depth')}.webp"
    trained = load_stored(run, options.overrides)
    renderer = Renderer(trained)
    cameras = cameras_of(trained, renderer, options)
    width, height = cameras[0].width, cameras[0].height
    video.check(out, width, height, len(cameras))
    what = f"{count(len(cameras))} frames of {width} x {height}"
    seconds = renderer.evaluator.seconds(len(cameras) * width * height)
    if line := announced(what, seconds, trained.settings.run.hours, "--frames and --size make it shorter"):
        print(line, flush=True)
    start, screen = time.monotonic(), console()
    pictures = renderer.pictures(cameras, options.what)
    shown = track(pictures, "rendering", len(cameras), console=screen, disable=not screen.is_terminal)
    video.write(out, shown, options.fps)
    frame_text = f"{what}, {len(cameras) / options.fps:.1f} s of video"
    took = f"step {count(trained.step)}, rendered in {duration(time.monotonic() - start)}"
    print(f"{frame_text}, {took} -> {printable(out)}")


def cameras_of(trained: "Trained", renderer: "Renderer", options: argparse.Namespace) -> "list[Camera]":
    """The cameras of the path that the user asked for."""
    from qnerf.geometry.camera_paths import PATHS, Camera

    scene = trained.scene
    wide, high = scene.cameras.all_sizes[scene.train].double().median(0).values.tolist()
    usual = (round(length * LONGER_SIDE / max(wide, high) / 2) * 2 for length in (wide, high))
    width, height = options.size or tuple(max(2, side) for side in usual)
    focal = renderer.focal(width, height)
    poses = PATHS[options.path](scene.cameras.poses.numpy()[scene.train], options.frames)
    return [Camera(pose, focal, width, height) for pose in poses]
