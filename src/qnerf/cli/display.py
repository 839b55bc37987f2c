"""What a training shows on the terminal: the configuration as a tree, a progress bar, a closing table."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from qnerf.cli.text import tree
from qnerf.experiment import Display, Outcome


def print_config(console: Console, config: Mapping[str, Any]) -> None:
    """The resolved configuration as a tree."""
    console.print(tree("configuration", config))


class LiveDisplay(Display):
    """A progress bar with step, loss, PSNR, steps a second and time left; plain lines where there is no terminal."""

    def __init__(self, console: Console, live: bool = True) -> None:
        self.console = console
        self.progress = Progress(
            TextColumn("training"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(
                "loss {task.fields[loss]:.4f}  PSNR {task.fields[psnr]:.2f} dB  {task.fields[rate]:.1f} steps/s  left"
            ),
            TimeRemainingColumn(),
            console=console,
            disable=not live or not console.is_terminal,
        )
        self.every = 0

    def begin(self, path: Path, step: int, steps: int) -> None:
        line = f"run {path}" + (f", going on at step {step}" if step else "")
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)
        self.every = max(1, steps // 10)
        self.steps = steps
        self.task = self.progress.add_task("training", total=steps, completed=step, loss=0.0, psnr=0.0, rate=0.0)
        self.progress.start()

    def step(self, step: int, metrics: Mapping[str, float]) -> None:
        loss, psnr, rate = metrics["train/loss"], metrics["train/psnr"], 1e3 / metrics["time/step_ms"]
        self.progress.update(self.task, completed=step, loss=loss, psnr=psnr, rate=rate)
        if self.progress.disable and step % self.every == 0:
            line = f"step {step}/{self.steps}  loss {loss:.4f}  PSNR {psnr:.2f} dB  {rate:.1f} steps/s"
            self.console.print(line, highlight=False)

    def note(self, text: str) -> None:
        self.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def end(self) -> None:
        self.progress.stop()


def print_outcome(console: Console, outcome: Outcome) -> None:
    """A short table: quality on the held-out views, parameters a part, seconds, where the run lies."""
    if outcome.message:
        console.print(outcome.message, highlight=False, markup=False, soft_wrap=True)
    summary = outcome.summary
    if outcome.state != "finished":  # what is evaluated on the way is not the result
        return
    table = Table(show_header=False, box=None, padding=(0, 2))
    views = f"{summary['eval_views']:.0f} held-out views"
    table.add_row("PSNR", f"{summary['psnr']:.2f} dB", views)
    if summary.get("ssim") is not None:  # there is none of views below 3 pixels
        table.add_row("SSIM", f"{summary['ssim']:.3f}", "")
    if summary.get("lpips") is not None:
        table.add_row("LPIPS", f"{summary['lpips']:.4f}", "")
    if summary.get("depth_error") is not None:
        table.add_row("depth error", f"{summary['depth_error']:.3f}", "mean of |depth - truth| / the larger")
    parts = {key.removeprefix("params."): int(value) for key, value in summary.items() if key.startswith("params.")}
    listed = ", ".join(f"{name} {count:,}" for name, count in parts.items() if count and name != "total")
    table.add_row("parameters", f"{parts['total']:,}", listed)
    table.add_row("training", f"{summary['train_s']:.1f} s", f"{summary['step_ms']:.1f} ms a step, median")
    console.print(table)
    for name, path, what in (("run", "", ""), ("pictures", "images", "truth | render | error | depth")):
        line = f"  {name:<13} {outcome.path / path}  {what}".rstrip()
        console.print(line, highlight=False, markup=False, soft_wrap=True)
