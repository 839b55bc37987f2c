"""Terminal output of a training: what is trained, a progress bar, and a closing table."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from qnerf.cli.commands.show import pair, results
from qnerf.cli.ends import output_lost
from qnerf.cli.text import duration, measured
from qnerf.experiment import Display, Outcome
from qnerf.metrics import metric_of
from qnerf.records.printable import printable
from qnerf.training.task import Measures

BESIDE = 118  # characters beside a bar


class LiveDisplay(Display):
    """What is trained, then a progress bar with phase, step, elapsed time, loss, PSNR, rate, the last held-out PSNR and
    time left; plain lines without a terminal.

    changed: what the user has typed that acts; None: the start says nothing.
    judge: what a job of a search gives up by; None: it never does.
    label, beside: of a run that trains beside others: what tells it from them, and the display whose bars it shares.
    """

    def __init__(
        self,
        console: Console,
        live: bool = True,
        changed: Sequence[str] | None = None,
        judge: Callable[[Path, int, Measures], bool] | None = None,
        label: str = "",
        beside: "LiveDisplay | None" = None,
    ) -> None:
        self.console: Console = beside.console if beside else console
        self.changed = changed
        self.judge = judge
        self.label = label
        self.progress: Progress = (
            beside.progress
            if beside
            else Progress(
                TextColumn("{task.fields[phase]}", markup=False),
                BarColumn(max(8, min(40, console.width - BESIDE))),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[status]}"),
                TimeRemainingColumn(),
                TextColumn("left"),
                console=console,
                disable=not live or not console.is_terminal,
            )
        )
        self.every = 0
        self.held_out_text = ""

    def describe(self, config: Mapping[str, Any], parameters: Mapping[str, int]) -> None:
        """Prints the parts of the model with their parameters, and what the user has typed."""
        if self.changed is None:
            return
        for column, count in parameters.items():
            part = column.removeprefix("params.")
            if count and part != "total":
                node = config.get(part)
                name = f"{node['name']}, " if isinstance(node, Mapping) and "name" in node else ""
                self.note(f"{part} {printable(name)}{count:,} parameters")
        self.note(f"changed {printable(' '.join(self.changed) or 'nothing, all options are at their defaults')}")

    def begin(self, path: Path, step: int, steps: int) -> None:
        self.note(f"run {path}" + (f", resuming at step {step}" if step else ""))
        self.every = max(1, steps // 10)
        self.steps = steps
        self.started = time.monotonic()
        self.task = self.progress.add_task(
            "training", total=steps, completed=step, status="", phase=self.labelled("compile")
        )
        self.progress.start()

    def phase(self, name: str) -> None:
        self.progress.update(self.task, phase=self.labelled(name))
        if self.progress.disable and name.startswith("evaluate 1 of ") and name != "evaluate 1 of 1 views":
            self.note(f"evaluating {name.removeprefix('evaluate 1 of ')}")

    def step(self, step: int, metrics: Mapping[str, float]) -> None:
        status = self.status(metrics)
        self.progress.update(self.task, completed=step, status=status)
        if self.progress.disable and step % self.every == 0:
            self.note(f"step {step}/{self.steps}  {duration(time.monotonic() - self.started)}  {status}")

    def status(self, metrics: Mapping[str, float]) -> str:
        """Loss, PSNR, rate and the last held-out value."""
        values = [
            f"{metric_of(key).label} {metric_of(key).with_unit(metrics[f'train/{key}'])}"
            for key in ("loss", "psnr")
            if f"train/{key}" in metrics
        ]
        parts = [*values, f"{1e3 / metrics['time/step_ms']:.1f} steps/s", self.held_out_text]
        return "  ".join(filter(None, parts))

    def held_out(self, step: int, metric: str, value: float | str | None, views: str) -> None:
        item = metric_of(metric)
        text = measured(value, item, unit=True)
        self.held_out_text = f"held out {text} ({views})" if views else text
        self.note(
            f"step {step}: held-out {item.label} {text}, {views}" if views else f"step {step}: {item.label} {text}"
        )

    def note(self, text: str) -> None:
        self.console.print(self.labelled(text), highlight=False, markup=False, soft_wrap=True)

    def labelled(self, text: str) -> str:
        return f"{self.label}: {text}" if self.label else text

    def stopping(self) -> bool:
        return output_lost()

    def unpromising(self, path: Path, step: int, measured: Measures) -> bool:
        return self.judge is not None and self.judge(path, step, measured)

    def end(self) -> None:
        self.progress.stop_task(self.task)
        if all(task.stop_time is not None for task in self.progress.tasks):
            self.progress.stop()


def print_outcome(console: Console, outcome: Outcome, brief: bool = False) -> None:
    """Prints the results as `qnerf show` does, and the run's folder.

    That a run was interrupted goes to standard error. brief: no results of a run that was finished before.
    """
    if outcome.state == "interrupted":
        print(printable(outcome.message), file=sys.stderr)
    elif outcome.message:
        console.print(outcome.message, highlight=False, markup=False, soft_wrap=True)
    # Evaluations during training are not the result.
    if outcome.state != "finished" or (brief and outcome.message):
        return
    for name, text in results(outcome.summary):
        pair(console, name, text)
    panels = "truth | fit | error" if "head" in outcome.summary else "truth | render | error | depth"
    pair(console, "folder", str(outcome.path))
    pair(console, "pictures", f"{outcome.path / 'images'}, {panels}")
