"""`qnerf capture IMAGES|VIDEO --out DIR`."""

import argparse
import shlex
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from qnerf.cli.numbers import count
from qnerf.cli.text import console
from qnerf.records.printable import printable

STAGES = {
    "frames": "frames of the video",
    "features": "features",
    "matches": "pairs of photographs",
    "poses": "poses",
    "undistort": "undistorted images",
}
NAMED = 10  # photographs without a pose that are named


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Finds the poses of photographs or of a video's frames with COLMAP and writes a folder for scene=nerfstudio. "
        "Lens distortion is undone. The folder appears when it is complete."
    )
    parser.add_argument("source", type=Path, metavar="IMAGES|VIDEO", help="a folder of photographs, or a video")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the new folder of the scene")
    parser.add_argument("--frames", type=count, default=150, help="to take from a video (default: %(default)s)")
    parser.add_argument(
        "--lens",
        choices=["auto", "shared", "each"],
        default="auto",
        help="shared: one camera and zoom took all; each: every photograph has its own focal length; "
        "auto (default): shared if all have one size",
    )
    parser.add_argument(
        "--order",
        choices=["auto", "any", "sequence"],
        default="auto",
        help="sequence: compare neighbours in the order of names only; any: all pairs; "
        "auto (default): for a video sequence first",
    )


def main(options: argparse.Namespace) -> None:
    from qnerf.capture.photographs import capture

    columns = (TextColumn("{task.description:<22}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    out = console()
    with Progress(*columns, console=out, disable=not out.is_terminal) as bars:
        tasks = {}

        def progress(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(STAGES[what], total=total)
                if bars.disable:  # a log gets a line a stage
                    print(f"{STAGES[what]}: {total}", flush=True)
            bars.update(tasks[what], completed=done, total=total)

        given = {"frames": options.frames, "lens": options.lens, "order": options.order}
        captured = capture(options.source, options.out, progress=progress, **given)
    total = len(captured.posed) + len(captured.others)
    print(f"{len(captured.posed)} of {total} photographs were posed, features are {captured.error:.2f} pixels off")
    if captured.others:
        more = f" and {len(captured.others) - NAMED} more" if len(captured.others) > NAMED else ""
        print(f"not posed: {', '.join(map(printable, captured.others[:NAMED]))}{more}")
    if len(captured.posed) < total / 2:
        print("less than half were posed: take more photographs in between, so that neighbours overlap by half or more")
    if len(captured.groups) > 1:
        sizes = ", ".join(map(str, captured.groups))
        print(f"they fall into {len(captured.groups)} groups that share nothing, of {sizes}; the first was taken")
    folder = shlex.quote(f"scene.path={printable(options.out)}")
    print(f"next: qnerf run scene=nerfstudio {folder} scene.width=64")
