"""The sections of tables and figures below the interactive part of the page."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from ..figures import FIGURES
from ..paper import PAPER_TABLES
from ..selection import by_scene
from ..tables import Table
from ..verdict import within_of
from .figures import Drawn, draw
from .tables import ShownTable, attempt, decisions, over_seeds, smallest_configurations

SHOWN_ABOVE = ("loss", "forest")
"""Figures that the page's curves and verdicts show; `qnerf figures` writes them."""


@dataclass
class Part:
    """A section of tables and figures; `name` is its short title, `absent` says what cannot be shown and why."""

    id: str
    name: str
    title: str
    text: str = ""
    tables: list[ShownTable] = field(default_factory=list)
    figures: list[Drawn] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)


def parts(frame: pd.DataFrame, baseline: str | None) -> list[Part]:
    """Tables and figures of the store, in the order of the page; baseline: None for the classical configuration."""
    configurations = Part("tables", "Tables", "Configurations over seeds")
    small = f"The fewest parameters within {within_of('psnr'):g} dB of the best"
    configurations.tables = [
        attempt("Mean ± standard deviation over seeds", over_seeds, frame, baseline),
        attempt(small, smallest_configurations, frame),
    ]
    if (decided := decisions(Path(str(frame["path"].iloc[0])).parent)) is not None:
        configurations.tables.append(decided)
    paper = Part("paper", "Paper", "The paper's tables and figures, with ours")
    without = []
    for title, make in PAPER_TABLES.values():
        tables = beside_ours(title, make, frame)
        paper.tables += tables
        without += [] if tables else [title]
    if without:
        paper.text = f"No run is a row of: {'; '.join(without)}."
    more = Part("more", "Figures", "More figures")
    for name in [name for name in FIGURES if name not in SHOWN_ABOVE]:
        drawn, absent = draw(name, frame, baseline)
        part = paper if FIGURES[name].paper else more
        part.figures += drawn
        part.absent += absent
    return [configurations, paper, more]


def beside_ours(title: str, make: Callable[[pd.DataFrame], Table], frame: pd.DataFrame) -> list[ShownTable]:
    """A table of the paper for each scene that has runs in it."""
    scenes = by_scene(frame)
    names = [title] if len(scenes) == 1 else [f"{title}: {scene}" for scene in scenes]
    made = [attempt(name, make, own) for name, own in zip(names, scenes.values(), strict=True)]
    return [table for table in made if _has_ours(table)]


def _has_ours(table: ShownTable) -> bool:
    """Whether any row has a seed of ours; their number is the last column of every table of the paper."""
    return table.table is not None and bool((table.table.text.iloc[:, -1] != "0").any())
