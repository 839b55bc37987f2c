"""Figures by name, into files."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records.files import one_line
from qnerf.records.printable import printable

from ..output import make_folder
from ..style import save
from .catalogue import FIGURES


def check_names(names: Sequence[str]) -> None:
    """Raises ValueError, with the known names, for a name that no figure has."""
    unknown = [name for name in names if name not in FIGURES]
    if unknown:
        raise ValueError(f"unknown figure {unknown[0]!r}; known: {', '.join(FIGURES)}")


def draw(frame: pd.DataFrame, names: Sequence[str], out: Path, formats: Sequence[str], **options: Any) -> None:
    """Writes the named figures, or all of them if `names` is empty, into the folder `out`; options as `Entry.draw`.

    Prints the files that it wrote, and a line for each figure that cannot be drawn. ValueError for an unknown format,
    or where a figure that was named cannot be drawn for any scene.
    """
    make_folder(out)
    failed = []
    left: dict[str, str] = {}
    for name in names or FIGURES:
        errors: dict[str, str] = {}
        scenes = FIGURES[name].scenes(name, frame)
        for file, runs in scenes.items():
            figure = None
            with collecting(errors, file):
                figure = FIGURES[name].draw(runs, **options)
            if figure is not None:
                print(*save(figure, out / file_name(file), formats))
        if name in names and len(errors) == len(scenes):
            failed.append(next(iter(errors.values())))
        else:
            left |= errors
    for reason, files in by_reason(left).items():
        print(f"not drawn: {printable(files)}: {printable(reason)}")
    if failed:
        raise ValueError("; ".join(failed))


@contextlib.contextmanager
def collecting(errors: dict[str, str], name: str) -> Iterator[None]:
    """Puts the reason into `errors` under the name if a figure or table cannot be made; OSError stays an error."""
    try:
        yield
    except OSError:
        raise
    except ValueError as error:
        errors[name] = str(error)
    except Exception as error:  # runs of another program may lack what a figure needs
        errors[name] = f"{type(error).__name__}: {one_line(error)}"


def by_reason(errors: Mapping[str, str]) -> dict[str, str]:
    """Reason -> the names of what could not be made for it, between commas."""
    found: dict[str, list[str]] = {}
    for name, reason in errors.items():
        found.setdefault(reason, []).append(name)
    return {reason: ", ".join(names) for reason, names in found.items()}


def file_name(name: str) -> str:
    """The name without characters that lead to another folder or that no file can have; a scene may have any name."""
    return "".join(c if c.isprintable() and c not in "/\\" else "_" for c in name)[:200]


def title(file: str) -> str:
    """The title of a figure from the name of a file that `draw` wrote, without its suffix; else that name in words."""
    name = file if file in FIGURES else file.partition("_")[0]  # a figure of one scene is in <name>_<scene>
    return FIGURES[name].title if name in FIGURES else file.replace("_", " ")
