"""The sections of tables and figures below the interactive part of the page."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from ..figures import FIGURES
from ..figures.files import by_reason
from .figures import Drawn, draw
from .tables import ShownTable, attempt, decisions, over_seeds

SHOWN_ABOVE = ("loss", "forest")
"""Figures that the page's curves and verdicts show; `qnerf figures` writes them."""


@dataclass
class Part:
    """A section of tables and figures; `name` is its short title, `absent` says what cannot be shown and why."""

    id: str
    name: str
    title: str
    tables: list[ShownTable] = field(default_factory=list)
    figures: list[Drawn] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)


def parts(frame: pd.DataFrame, **judged: Any) -> list[Part]:
    """Tables and figures of the store, in the order of the page; judged: as of `over_seeds`."""
    configurations = Part("tables", "Tables", "Configurations over seeds")
    configurations.tables = [attempt("Mean ± standard deviation over seeds", lambda: over_seeds(frame, **judged))]
    if (decided := decisions(Path(str(frame["path"].iloc[0])).parent)) is not None:
        configurations.tables.append(decided)
    more = Part("more", "Figures", "Figures")
    absent: dict[str, str] = {}
    for name in [name for name, entry in FIGURES.items() if name not in SHOWN_ABOVE and entry.suits(frame)]:
        drawn, reasons = draw(name, frame, **judged)
        more.figures += drawn
        absent |= reasons
    more.absent = [f"{titles}: {reason}" for reason, titles in by_reason(absent).items()]
    return [configurations, more] if more.figures or more.absent else [configurations]
