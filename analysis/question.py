"""A question of docs/results: what was asked, the commands that train its runs, the tables that answer it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd

from .paper import PAPER_TABLES
from .tables import Table, ablation, resources, units

QUALITY = ("psnr", "ssim", "depth_error")


@dataclass(frozen=True)
class Question:
    """A page of results: a question, the commands that train its runs, and the tables that answer it.

    rows: the keys that distinguish the rows of each table.
    baseline: the row that the others are compared with; other_baselines: more of them, for a table each.
    metric: what the tables compare and rank; within: its smallest difference that matters, where not the usual one.
    values: the columns; those that no run has are left out.
    failures: whether to say which runs slipped or collapsed; units, hardware: whether to add the table of that name.
    paper: the names of the paper's tables to add.
    """

    title: str
    commands: Sequence[str]
    rows: Sequence[str]
    baseline: Mapping[str, object] | None = None
    metric: str = "psnr"
    within: float | None = None
    values: Sequence[str] = QUALITY
    failures: bool = False
    units: bool = False
    hardware: bool = False
    paper: Sequence[str] = ()
    other_baselines: Sequence[Mapping[str, object]] = ()

    def tables(self, frame: pd.DataFrame) -> list[Table]:
        """The tables of the question's runs, as `load.runs` gives them."""
        values = [name for name in self.values if name in frame and frame[name].notna().any()]
        tables = [
            ablation(frame, self.rows, metric=self.metric, values=values, baseline=self.baseline, within=self.within)
        ]
        for other in self.other_baselines:
            tables.append(
                ablation(
                    frame, self.rows, metric=self.metric, values=(self.metric,), baseline=other, within=self.within
                )
            )
        wanted = ((self.units, units), (self.hardware, resources))
        tables += [make(frame, self.rows) for wants, make in wanted if wants]
        return tables + [PAPER_TABLES[name][1](frame) for name in self.paper]

    def table_command(self, name: str) -> str:
        """The command that makes its first table from the packed runs in docs/results/`name`."""
        command = f"qnerf tables docs/results/{name} --rows {','.join(self.rows)}"
        if self.metric != "psnr":
            command += f" --metric {self.metric} --values {','.join(self.values)}"
        if self.within is not None:
            command += f" --within {self.within:g}"
        if self.baseline is None:
            return command
        return f"{command} --baseline {','.join(f'{key}={value}' for key, value in self.baseline.items())}"
