"""A question of docs/results: what was asked, the commands that train its runs, the tables that answer it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pandas as pd
from qnerf.analysis.tables import Table, ablation, resources, units

from docs.tools.paper.tables import PAPER_TABLES
from qnerf.metrics import metric_of


@dataclass(frozen=True)
class Question:
    """A page of results: a question, the commands that train its runs, and the tables that answer it.

    rows: the keys that distinguish the rows of each table.
    baseline: the row that the others are compared with; other_baselines: more of them, for a table each.
    metric: what the tables compare and rank; within: its smallest difference that matters, where not the usual one.
    other_metrics: more that are compared with the baseline.
    values: columns beside the metric; those that no run has are left out.
    best_of: the row key of which a page shows the best value alone, where rows are otherwise alike.
    units, hardware, paper: whether its page shows another table in place of the comparison: of dead units, of shots and
    noise, or the paper's table of that name.
    """

    title: str
    commands: Sequence[str]
    rows: Sequence[str]
    baseline: Mapping[str, object] | None = None
    metric: str = "psnr"
    within: float | None = None
    values: Sequence[str] = ()
    best_of: str = ""
    units: bool = False
    hardware: bool = False
    paper: str = ""
    other_baselines: Sequence[Mapping[str, object]] = ()
    other_metrics: Sequence[str] = ()

    @property
    def comparisons(self) -> list[tuple[str, Mapping[str, object] | None]]:
        """The metric and the baseline of each of `tables`."""
        own = [(self.metric, baseline) for baseline in (self.baseline, *self.other_baselines)]
        return own + [(metric, self.baseline) for metric in self.other_metrics]

    def tables(self, frame: pd.DataFrame) -> list[Table]:
        """A table for each of `comparisons`, of runs as `load.runs` gives them; the first has `values`."""
        values = [name for name in self.values if name in frame and frame[name].notna().any()]
        return [
            ablation(
                frame,
                self.rows,
                metric=metric,
                values=[metric, *values * (number == 0)],
                baseline=baseline,
                within=self.within,
            )
            for number, (metric, baseline) in enumerate(self.comparisons)
        ]

    def instead(self, frame: pd.DataFrame) -> Table | None:
        """The table that its page shows in place of the comparisons, where it has one."""
        if self.paper:
            return PAPER_TABLES[self.paper][1](frame)
        if self.units:
            return units(frame, self.rows)
        if self.hardware:
            table = resources(frame, self.rows)
            asked = [*self.rows, *(metric_of(name).heading for name in self.values)]
            shown = [name for name in table.text if name in asked or name.startswith("PSNR")]
            return Table(table.title, table.text[shown], table.data, table.bold[shown])
        return None

    def table_command(self, name: str) -> str:
        """The command that makes its table from the packed runs in docs/results/`name`."""
        if self.paper:
            return f"python -m docs.tools.paper {self.paper} docs/results/{name}"
        command = f"qnerf tables docs/results/{name}"
        command += f" --rows {','.join(self.rows)}" + " --units" * self.units + " --resources" * self.hardware
        if self.metric != "psnr":
            command += f" --metric {self.metric} --values {','.join((self.metric, *self.values))}"
        if self.within is not None:
            command += f" --within {self.within:g}"
        if self.baseline is None:
            return command
        return f"{command} --baseline {','.join(f'{key}={value}' for key, value in self.baseline.items())}"
