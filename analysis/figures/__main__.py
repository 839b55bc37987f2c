"""`python -m analysis.figures STORE --out DIR [NAME ...] [--filter field=qcolor]`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..command import chosen, run
from ..query import HELP
from ..style import FORMATS
from . import FIGURES
from .files import check_names, draw


def main(arguments: Sequence[str] | None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m analysis.figures",
        description="Draws the figures of a store of runs.",
        epilog="; ".join(f"{name}: {entry.title}" for name, entry in FIGURES.items()),
    )
    parser.add_argument("store", help="folder of runs")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"figures; without any, all: {', '.join(FIGURES)}")
    parser.add_argument("--out", default="figures", metavar="DIR", help="where to write (default: figures)")
    parser.add_argument("--filter", metavar="TEXT", help=HELP)
    parser.add_argument("--formats", default=",".join(FORMATS), metavar="png,svg,pdf")
    parser.add_argument("--theme", default="light", choices=["light", "dark"])
    options = parser.parse_intermixed_args(arguments)
    check_names(options.names)
    draw(chosen(options), options.names, Path(options.out), options.formats.split(","), options.theme)


if __name__ == "__main__":
    run(main)
