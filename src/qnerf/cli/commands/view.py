"""`qnerf view RUN [RUN]`: look around in the browser."""

import argparse
import contextlib
import time

from qnerf.cli.commands import add_many_runs
from qnerf.cli.numbers import count
from qnerf.records import find


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Opens a page on which you look around in a run's scene, or in that of two runs of one scene: switched, or the "
        "left half of one beside the right half of the other. While a run trains, the page follows its checkpoints. "
        "Needs the extra view."
    )
    add_many_runs(parser)
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: this machine alone)")
    parser.add_argument("--port", type=port, default=8080, metavar="N", help="default: 8080")
    parser.add_argument(
        "--width", type=width, default=640, metavar="PIXELS", help="of the sharpest picture (default: 640)"
    )


def port(text: str) -> int:
    """A number of a port."""
    value = count(text)
    if not 1 <= value <= 65_535:
        raise argparse.ArgumentTypeError(f"expected a port from 1 to 65,535, got {text!r:.60}")
    return value


def width(text: str) -> int:
    """Pixels of a picture."""
    value = count(text)
    if not 16 <= value <= 4096:
        raise argparse.ArgumentTypeError(f"expected a width from 16 to 4,096 pixels, got {text!r:.60}")
    return value


def main(options: argparse.Namespace) -> None:
    plugins = [name for name in options.runs if name.startswith("plugins=")]
    folders = [find(name, options.store) for name in options.runs if name not in plugins]
    if not 1 <= len(folders) <= 2:
        raise ValueError(f"expected one run or two, got {len(folders)}")

    from qnerf.cli.upgrade_config import load_stored
    from qnerf.viewing.frames import Renderer
    from qnerf.viewing.viewer import Viewer

    renderers = [Renderer(load_stored(folder, plugins)) for folder in folders]
    viewer = Viewer(renderers, options.host, options.port, options.width)
    print(f"{', '.join(folder.name for folder in folders)}: {viewer.address}; Ctrl-C ends", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)
    viewer.stop()
