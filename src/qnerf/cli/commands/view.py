"""`qnerf view RUN [RUN]`: look around in the browser."""

import argparse
import contextlib
import time

from qnerf.cli.commands import STORED, add_many_runs
from qnerf.cli.numbers import whole
from qnerf.records import find


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Opens a page on which you look around in a run's scene, or in that of two runs of one scene: switched, or the "
        "left half of one beside the right half of the other. While a run trains, the page follows its checkpoints. "
        "Needs the extra view."
    )
    add_many_runs(parser, f"; or {STORED}")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine alone)")
    parser.add_argument("--port", type=whole(1, 65_535), default=8080, metavar="N", help="default: 8080")
    parser.add_argument(
        "--width", type=whole(16, 4096), default=640, metavar="PIXELS", help="of the sharpest picture (default: 640)"
    )


def main(options: argparse.Namespace) -> None:
    from qnerf.cli.stored import load_stored, split

    names, overrides = split(options.runs)
    folders = [find(name, options.store) for name in names]
    if not 1 <= len(folders) <= 2:
        raise ValueError(f"expected one run or two, got {len(folders)}")

    from qnerf.viewing.frames import Renderer
    from qnerf.viewing.viewer import Viewer

    renderers = [Renderer(load_stored(folder, overrides)) for folder in folders]
    viewer = Viewer(renderers, options.host, options.port, options.width)
    print(f"{', '.join(folder.name for folder in folders)}: {viewer.address}  (Ctrl-C ends)", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)
    viewer.stop()
