"""Figures by name, into files."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from . import FIGURES, save, scenes_of


def known(names: Sequence[str]) -> None:
    """ValueError that lists the figures there are, for a name that is none."""
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


def title(file: str) -> str:
    """Of the figure in a file that `draw` wrote, whose name ends with _<scene> where each scene has its own; of another
    file its name."""
    name = file if file in FIGURES else file.partition("_")[0]
    return FIGURES[name][0] if name in FIGURES else file
