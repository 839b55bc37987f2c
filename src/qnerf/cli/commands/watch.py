"""`qnerf watch [RUN]`: one run, or the table of the store, while it trains."""

import argparse
import contextlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from qnerf.cli.commands import RUN, add_store
from qnerf.cli.commands import runs as listing
from qnerf.cli.commands.show import state_line
from qnerf.cli.numbers import seconds
from qnerf.cli.sparkline import sparkline
from qnerf.cli.table import plain_lines, table
from qnerf.cli.text import console, count, duration, styled
from qnerf.metrics import metric_of
from qnerf.records import StoreError, details, find, read_metrics
from qnerf.records.details import Details
from qnerf.records.printable import printable
from qnerf.records.schemas import METRICS_SCHEMA

RECENT = 30  # logged steps over which the rate is measured
BESIDE = 46  # characters beside a bar or curve


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Shows a run, or without RUN the store's newest runs, and refreshes until the run ends or Ctrl-C. "
        "Without a terminal it prints once."
    )
    parser.add_argument("run", nargs="?", metavar="RUN", help=RUN)
    add_store(parser)
    parser.add_argument("--every", type=seconds, default=2.0, metavar="SECONDS", help="between refreshes (default: 2)")
    parser.add_argument("--once", action="store_true", help="print once")


def main(options: argparse.Namespace) -> None:
    out = console()
    if options.run is None:
        frame = partial(store_frame, options.store, out)
    else:
        frame = partial(run_frame, find(options.run, options.store), out)
    if options.once or not out.is_terminal:
        out.print(frame()[0], soft_wrap=True)
        return
    with contextlib.suppress(KeyboardInterrupt):
        follow(out, frame, options.every)


Frame = Callable[[], tuple[RenderableType, bool]]
"""Returns the current picture, and whether to keep refreshing it."""


def follow(out: Console, frame: Frame, every: float) -> None:
    picture, goes_on = frame()
    with Live(picture, console=out, auto_refresh=False) as live:
        while goes_on:
            time.sleep(every)
            picture, goes_on = frame()
            live.update(picture, refresh=True)


def store_frame(store: str, out: Console) -> tuple[RenderableType, bool]:
    """The newest runs that fit on the screen, refreshed until Ctrl-C."""
    frame = listing.load(store)
    if frame.empty:
        return Text(f"no runs in {printable(store)}"), True
    frame = listing.arrange(frame)
    rows = listing.records(listing.limited(frame, listing.screen(out)))
    columns = listing.columns(rows)
    lines = [table(columns, rows, out.width)] if out.is_terminal else map(Text, plain_lines(columns, rows))
    return Group(*lines, Text(listing.counts(frame, len(rows)), "dim")), True


def run_frame(folder: Path, out: Console) -> tuple[RenderableType, bool]:
    """A run's progress, refreshed while it runs."""
    run = details.read(folder)
    try:
        metrics = read_metrics(folder)
    except StoreError as error:
        run.problems.append(str(error))
        metrics = METRICS_SCHEMA.empty_table().to_pandas()
    lines = progress(run, metrics, out.width)
    return Group(*lines), run.state == "running"


def progress(run: Details, metrics: pd.DataFrame, width: int) -> list[Text]:
    """Lines: state, a bar with rate and time left, the curves of loss and PSNR, the held-out views so far."""
    lines = [styled(run.run_id, "bold"), state_line(run)]
    if run.error and run.state == "failed":
        lines.append(styled(run.error, "red", 2000))
    lines += [styled(problem, "red", 2000) for problem in run.problems]
    curves = dict(list(metrics.groupby("key", sort=False)))
    loss = curves.get("train/loss")
    if run.steps and run.state == "running":
        lines.append(_bar(run, steps_per_second(loss) if loss is not None else None, width))
    for key, (title, transform) in CURVES.items():
        if key in curves:
            values = curves[key]["value"].to_numpy()
            drawn = sparkline(transform(values), max(width - BESIDE, 10))
            last = f"{metric_of(key).with_unit(values[-1])} at step {count(curves[key]['step'].iloc[-1])}"
            lines.append(Text.assemble((f"{title:<10}", "dim"), (drawn, "cyan"), f"  {last}"))
    return lines


def _log(values: np.ndarray) -> np.ndarray:
    return np.log(np.where(values > 0, values, np.nan))


CURVES: dict[str, tuple[str, Callable[[np.ndarray], np.ndarray]]] = {
    "train/loss": (f"{metric_of('loss').label}, log", _log),
    "train/psnr": (metric_of("psnr").label, np.asarray),
    "eval/psnr": ("held out", np.asarray),
}
"""Key of metrics.parquet -> title, and the function applied to its values before drawing."""


def steps_per_second(rows: pd.DataFrame) -> float | None:
    """Rate over the last logged rows of one key; None if there are too few."""
    recent = rows.tail(RECENT)
    steps = recent["step"].iloc[-1] - recent["step"].iloc[0]
    seconds = recent["time_s"].iloc[-1] - recent["time_s"].iloc[0]
    return float(steps / seconds) if steps > 0 and seconds > 0 else None


def _bar(run: Details, rate: float | None, width: int) -> Text:
    assert run.steps
    share = min(run.step / run.steps, 1.0)
    room = max(width - BESIDE, 10)
    done = round(share * room)
    label = f"  {share:4.0%}"
    if rate is not None:
        label += f"  {rate:.1f} steps/s  {duration((run.steps - run.step) / rate)} left"
    return Text.assemble(" " * 10, ("━" * done, "green"), ("─" * (room - done), "dim"), label)
