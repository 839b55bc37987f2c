"""`qnerf diff A B`: what differs between two runs."""

import argparse
from collections.abc import Mapping
from operator import itemgetter
from typing import Any

from rich.text import Text

from qnerf.cli.commands import RUN, add_store
from qnerf.cli.table import Column, print_table
from qnerf.cli.text import as_json, console
from qnerf.config.checks import is_number
from qnerf.config.identity import flatten
from qnerf.records import details, find
from qnerf.records.printable import printable

TITLES = ("key", "A", "B", "change")


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "What differs between two runs: configuration, environment and results, side by side."
    for name in ("a", "b"):
        parser.add_argument(name, metavar=name.upper(), help=RUN)
    add_store(parser)
    parser.add_argument("--json", action="store_true", help="the same as one object, numbers in full")


def main(options: argparse.Namespace) -> None:
    a, b = (details.read(find(name, options.store)) for name in (options.a, options.b))
    for run in (a, b):
        run["environment"].pop("command", None)
    sections = {
        "configuration": differences(flatten(a["config"]), flatten(b["config"])),
        "environment": differences(flatten(a["environment"]), flatten(b["environment"])),
        "results": differences(a["results"], b["results"]),
    }
    if options.json:
        print(as_json({"a": a["path"], "b": b["path"], "state": [a["state"], b["state"]], **sections}))
        return
    out = console()
    for letter, run in (("A", a), ("B", b)):
        out.print(Text.assemble((f"{letter}  ", "bold"), printable(run["run_id"]), f"  {run['state']}"), soft_wrap=True)
        for problem in run["problems"]:
            out.print(Text(f"   {printable(problem)}", "red"), soft_wrap=True)
    for name, found in sections.items():
        out.print(f"\n{name}" if found else f"\nno differences in {name}", style="bold cyan" if found else "")
        if found:
            rows = [dict(zip(TITLES, (key, *map(_text, values)), strict=True)) for key, values in found.items()]
            print_table(out, [Column(title, itemgetter(title), limit=60) for title in TITLES], rows)


def differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Name -> [value in a, value in b, b - a] of what differs; None stands for a missing name or number."""
    pairs = {name: (a.get(name), b.get(name)) for name in {**a, **b} if a.get(name) != b.get(name)}
    return {
        name: [one, other, other - one if is_number(one) and is_number(other) else None]
        for name, (one, other) in pairs.items()
    }


def _text(value: Any) -> str:
    if not is_number(value):
        return "-" if value is None else str(value)
    return f"{int(value):,}" if float(value).is_integer() and abs(value) < 1e15 else f"{value:.4g}"
