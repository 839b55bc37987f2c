"""`qnerf view RUN`: look around in the browser."""

import argparse
import contextlib
import time

from qnerf.cli.commands import add_overrides, add_run
from qnerf.cli.numbers import whole
from qnerf.records import find


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Opens a page on which you look around in a run's scene. While the run trains, the page follows its "
        "checkpoints. Needs the extra view."
    )
    add_run(parser)
    add_overrides(parser)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine alone)")
    parser.add_argument("--port", type=whole(1, 65_535), default=8080, metavar="N", help="default: 8080")
    parser.add_argument(
        "--width", type=whole(16, 4096), default=640, metavar="PIXELS", help="of the sharpest picture (default: 640)"
    )


def main(options: argparse.Namespace) -> None:
    from qnerf.cli.stored import load_stored
    from qnerf.viewing.frames import Renderer
    from qnerf.viewing.viewer import Viewer

    folder = find(options.run, options.store)
    viewer = Viewer(Renderer(load_stored(folder, options.overrides)), options.host, options.port, options.width)
    print(f"{folder.name}: {viewer.address}  (Ctrl-C ends)", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)
    viewer.stop()
