"""`qnerf reproduce RUN [--tolerance 1e-6]`."""

import argparse
import dataclasses
import sys
import tempfile
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qnerf.cli.commands import add_overrides, add_run
from qnerf.cli.ends import FAILED, stoppable, stopped_code
from qnerf.cli.numbers import number
from qnerf.cli.stored import run_stored, stored
from qnerf.cli.table import Column, print_table
from qnerf.cli.text import console
from qnerf.config.identity import flatten
from qnerf.records import details, find, state
from qnerf.records.environment import differences
from qnerf.records.printable import printable

if TYPE_CHECKING:
    from qnerf.records.reproduction import Compared

COLUMNS = (
    Column("table", itemgetter("table")),
    Column("name", itemgetter("name")),
    Column("numbers", lambda row: f"{row['numbers']:,}", right=True),
    Column("missing", lambda row: f"{row['missing']:,}", right=True),
    Column("relative difference", lambda row: f"{row['largest']:.3g}", right=True),
    Column("first at", itemgetter("first")),
)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Trains a finished run again with its configuration, seed and threads, compares every number except times, and "
        "lists the differences of the environments. Exit code 1: numbers differ."
    )
    add_run(parser)
    add_overrides(parser)
    parser.add_argument(
        "--tolerance",
        metavar="X",
        type=number(0, 1e9),
        default=0.0,
        help="relative difference |a - b| / max(|a|, |b|) up to which numbers agree (default: 0, bit for bit)",
    )


@stoppable()
def main(options: argparse.Namespace) -> int:
    run = find(options.run, options.store).resolve()
    if (now := state(run)) != "finished":
        raise ValueError(f"{run}: is {now}; only a finished run can be reproduced")
    configuration = stored(run, options.overrides)

    from qnerf.records.reproduction import compare

    then = details.read(run)["environment"]
    threads = configuration["threads"] or flatten(then).get("threads.torch")
    with tempfile.TemporaryDirectory(prefix="qnerf-reproduce-") as store:
        outcome = run_stored(run, configuration.with_values({"store": store, "threads": threads}))
        if outcome.state != "finished":
            print(f"{printable(run.name)}: not compared, the second run is {outcome.state}", file=sys.stderr)
            return stopped_code() if outcome.state == "interrupted" else FAILED
        compared = list(compare(run, outcome.path))
        changed = differences(then, details.read(outcome.path)["environment"])
        different = {name: values for name, values in changed.items() if any(values)}
    return report(run, compared, different, options.tolerance)


def report(run: Path, compared: "Sequence[Compared]", different: Mapping[str, tuple[Any, Any]], limit: float) -> int:
    """Prints which numbers agree, which differ, and how the environments differ; returns the exit code."""
    out = console()
    wrong = [item for item in compared if not item.agrees(limit)]
    numbers, largest = sum(item.numbers for item in compared), max((item.largest for item in compared), default=0.0)
    if wrong:
        print_table(out, COLUMNS, [dataclasses.asdict(item) for item in wrong])
        print(f"{printable(run.name)}: not reproduced, {len(wrong)} of {len(compared)} names differ (above)")
    else:
        how = f"within {limit:g}; the largest relative difference is {largest:.3g}" if largest else "bit for bit"
        print(f"{printable(run.name)}: reproduced, {numbers:,} numbers agree {how}")
    if different:
        print("the environment differs:")
        rows = [{"name": name, "then": str(then), "now": str(now)} for name, (then, now) in different.items()]
        print_table(out, [Column(title, itemgetter(title), limit=60) for title in ("name", "then", "now")], rows)
    elif wrong:
        print("the recorded environments are the same")
    return FAILED if wrong else 0
