"""Figures by name, into files."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ..style import save
from .catalogue import FIGURES


def check_names(names: Sequence[str]) -> None:
    """Raises ValueError, with the known names, for a name that no figure has."""
    unknown = [name for name in names if name not in FIGURES]
    if unknown:
        raise ValueError(f"unknown figure {unknown[0]!r}; known: {', '.join(FIGURES)}")


def draw(frame: pd.DataFrame, names: Sequence[str], out: Path, formats: Sequence[str], theme: str = "light") -> None:
    """Writes the named figures, or all of them if `names` is empty, into the folder `out`.

    Prints the files that it wrote, and a line for each figure that cannot be drawn. Raises ValueError if a figure that
    was named cannot be drawn for any scene.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in names or FIGURES:
        errors = {}
        scenes = FIGURES[name].scenes(name, frame)
        for file, runs in scenes.items():
            try:
                figure = FIGURES[name].draw(runs, theme=theme)
            except ValueError as error:
                errors[file] = error
            else:
                print(*save(figure, out / file, formats))
        if name in names and len(errors) == len(scenes):
            raise next(iter(errors.values()))
        for file, reason in errors.items():
            print(f"{file}: not drawn: {reason}")


def title(file: str) -> str:
    """The title of a figure from the name of a file that `draw` wrote, without its suffix; `file` for other names."""
    name = file if file in FIGURES else file.partition("_")[0]  # a figure of one scene is in <name>_<scene>
    return FIGURES[name].title if name in FIGURES else file
