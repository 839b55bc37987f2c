"""`python -m analysis.figures STORE --out DIR [NAME ...] [--filter field=qcolor]`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from analysis.command import chosen, run
from analysis.figures import FIGURES, save, scenes_of
from analysis.query import HELP
from analysis.style import FORMATS


def main(arguments: Sequence[str] | None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m analysis.figures",
        description="Draws the figures of a store of runs.",
        epilog="; ".join(f"{name}: {title}" for name, (title, _) in FIGURES.items()),
    )
    parser.add_argument("store", help="folder of runs")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"figures; without any, all: {', '.join(FIGURES)}")
    parser.add_argument("--out", default="figures", metavar="DIR", help="where to write (default: figures)")
    parser.add_argument("--filter", metavar="TEXT", help=HELP)
    parser.add_argument("--formats", default=",".join(FORMATS), metavar="png,svg,pdf")
    parser.add_argument("--theme", default="light", choices=["light", "dark"])
    options = parser.parse_intermixed_args(arguments)
    known(options.names)
    draw(chosen(options), options.names, Path(options.out), options.formats.split(","), options.theme)


def known(names: Sequence[str]) -> None:
    unknown = [name for name in names if name not in FIGURES]
    if unknown:
        raise ValueError(f"unknown figure {unknown[0]!r}; known: {', '.join(FIGURES)}")


def draw(frame: pd.DataFrame, names: Sequence[str], out: Path, formats: Sequence[str], theme: str = "light") -> None:
    """Writes what can be drawn. A figure that was asked for by name and cannot be is an error, others are told of."""
    out.mkdir(parents=True, exist_ok=True)
    for name in names or FIGURES:
        mistakes = {}
        shown = scenes_of(name, frame)
        for file, own in shown.items():
            try:
                figure = FIGURES[name][1](own, theme=theme)
            except ValueError as error:
                mistakes[file] = error
            else:
                print(*save(figure, out / file, formats))
        if name in names and len(mistakes) == len(shown):
            raise next(iter(mistakes.values()))
        for file, mistake in mistakes.items():
            print(f"{file}: not drawn: {mistake}")


if __name__ == "__main__":
    run(main)
