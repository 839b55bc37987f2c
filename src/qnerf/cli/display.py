"""Terminal output of a training: a progress bar and a closing table."""

import sys
import time
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from qnerf.cli.text import duration, measured
from qnerf.config.checks import is_number
from qnerf.experiment import Display, Outcome
from qnerf.metrics import metric_of, quality_metrics
from qnerf.records.printable import printable

BESIDE = 118  # characters beside a bar


class LiveDisplay(Display):
    """A progress bar with phase, step, elapsed time, loss, PSNR, rate, the last held-out PSNR and time left;
    plain lines without a terminal."""

    def __init__(self, console: Console, live: bool = True) -> None:
        self.console = console
        self.progress = Progress(
            TextColumn("{task.fields[phase]}"),
            BarColumn(max(8, min(40, console.width - BESIDE))),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[status]}"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=console,
            disable=not live or not console.is_terminal,
        )
        self.every = 0
        self.held_out_text = ""

    def begin(self, path: Path, step: int, steps: int) -> None:
        line = f"run {path}" + (f", resuming at step {step}" if step else "")
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)
        self.every = max(1, steps // 10)
        self.steps = steps
        self.started = time.monotonic()
        self.task = self.progress.add_task("training", total=steps, completed=step, status="", phase="compile")
        self.progress.start()

    def phase(self, name: str) -> None:
        self.progress.update(self.task, phase=name)
        if self.progress.disable and name.startswith("evaluate 1 of "):
            self.note(f"evaluating {name.removeprefix('evaluate 1 of ')}")

    def step(self, step: int, metrics: Mapping[str, float]) -> None:
        values = [
            f"{metric_of(key).label} {metric_of(key).with_unit(metrics[f'train/{key}'])}"
            for key in ("loss", "psnr")
            if f"train/{key}" in metrics
        ]
        parts = [*values, f"{1e3 / metrics['time/step_ms']:.1f} steps/s", self.held_out_text]
        status = "  ".join(filter(None, parts))
        self.progress.update(self.task, completed=step, status=status)
        if self.progress.disable and step % self.every == 0:
            elapsed = duration(time.monotonic() - self.started)
            self.console.print(f"step {step}/{self.steps}  {elapsed}  {status}", highlight=False, soft_wrap=True)

    def held_out(self, step: int, metric: str, value: float | str | None, views: str) -> None:
        item = metric_of(metric)
        text = measured(value, item, unit=True)
        self.held_out_text = f"held out {text} ({views})" if views else text
        self.note(
            f"step {step}: held-out {item.label} {text}, {views}" if views else f"step {step}: {item.label} {text}"
        )

    def note(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def end(self) -> None:
        self.progress.stop()


def print_outcome(console: Console, outcome: Outcome, prefix: str = "") -> None:
    """Prints a short table: quality on the held-out views, parameters of each part, training time, the run's folder.

    That a run was interrupted goes to standard error, behind `prefix`.
    """
    if outcome.state == "interrupted":
        print(prefix + printable(outcome.message), file=sys.stderr)
    elif outcome.message:
        console.print(outcome.message, highlight=False, markup=False, soft_wrap=True)
    summary = outcome.summary
    if outcome.state != "finished":  # evaluations during training are not the result
        return
    table = Table(show_header=False, box=None, padding=(0, 2))
    if missing := [
        key for key in ("eval_views", "params.total", "train_s", "step_ms") if not is_number(summary.get(key))
    ]:
        console.print(f"no number for {', '.join(missing)} in its summary", highlight=False, markup=False)
        return
    fitted = "head" in summary  # a signal
    views = "the whole picture" if fitted else f"{summary['eval_views']:.0f} held-out views"
    for item in quality_metrics():
        if (value := summary.get(item.key)) is not None:
            table.add_row(item.label, item.with_unit(value), views if item.key == "psnr" else item.explanation)
    counts = {key.removeprefix("params."): value for key, value in summary.items() if key.startswith("params.")}
    parts = {name: int(value) for name, value in counts.items() if value is not None}
    listed = ", ".join(f"{name} {count:,}" for name, count in parts.items() if count and name != "total")
    table.add_row("parameters", f"{parts['total']:,}", listed)
    table.add_row(
        "training",
        f"{summary['train_s']:.1f} s",
        f"{metric_of('step_ms').with_unit(summary['step_ms'])} per step, median",
    )
    console.print(table)
    panels = "truth | fit | error" if fitted else "truth | render | error | depth"
    for name, path, content in (("run", "", ""), ("pictures", "images", panels)):
        line = f"  {name:<13} {outcome.path / path}  {content}".rstrip()
        console.print(line, highlight=False, markup=False, soft_wrap=True)
