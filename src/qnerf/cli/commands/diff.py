"""`qnerf diff A B`: what differs between two runs."""

import argparse
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.text import Text

from qnerf.cli.commands import RUN, add_store
from qnerf.cli.table import Column, print_table
from qnerf.cli.text import as_json, console
from qnerf.config.checks import is_number
from qnerf.config.identity import flatten
from qnerf.records import details, find
from qnerf.records.details import Details
from qnerf.records.printable import printable


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "What differs between two runs: configuration, environment, and the results side by side."
    for name in ("a", "b"):
        parser.add_argument(name, metavar=name.upper(), help=RUN)
    add_store(parser)
    parser.add_argument("--json", action="store_true", help="the same as one object, numbers in full")


def main(options: argparse.Namespace) -> None:
    a, b = (details.read(find(name, options.store)) for name in (options.a, options.b))
    compared = compare(a, b)
    if options.json:
        print(as_json(compared))
    else:
        show(console(), a, b, compared)


def compare(a: Details, b: Details) -> dict[str, Any]:
    """What differs, in sections.

    `configuration`, `environment`: name -> [value in A, value in B], only if they differ. `results`: name -> [A, B,
    B - A] for every number; the difference is None if one run has no number.
    """
    environments = ({key: value for key, value in run.environment.items() if key != "command"} for run in (a, b))
    return {
        "a": str(a.path),
        "b": str(b.path),
        "state": [a.state, b.state],
        "configuration": differences(a.flat, b.flat),
        "environment": differences(*map(flatten, environments)),
        "results": results(a.results, b.results),
    }


def differences(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Name -> [value in a, value in b], only if they differ; None stands for a missing name."""
    return {name: [a.get(name), b.get(name)] for name in {**a, **b} if a.get(name) != b.get(name)}


def results(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Name -> [A, B, B - A] for every name that is a number in one of the runs."""
    pairs: dict[str, list[Any]] = {name: [a.get(name), b.get(name)] for name in {**a, **b}}
    return {
        name: [*pair, pair[1] - pair[0] if all(map(is_number, pair)) else None]
        for name, pair in pairs.items()
        if any(map(is_number, pair))
    }


def show(out: Console, a: Details, b: Details, compared: Mapping[str, Any]) -> None:
    for letter, run in (("A", a), ("B", b)):
        out.print(Text.assemble((f"{letter}  ", "bold"), printable(run.run_id), f"  {run.state}"), soft_wrap=True)
        for problem in run.problems:
            out.print(Text(f"   {printable(problem)}", "red"), soft_wrap=True)
    for name in ("configuration", "environment"):
        if compared[name]:
            _section(out, name, compared[name], ("A", "B"))
        else:
            out.print(f"\nno differences in {name}")
    if not compared["configuration"] and a.run_id != b.run_id and not (a.problems or b.problems):
        out.print("the ids differ, so the scene's files differ")
    _section(out, "results", compared["results"], ("A", "B", "change"), numbers=True)


def _section(
    out: Console, title: str, compared: Mapping[str, list[Any]], titles: tuple[str, ...], numbers: bool = False
) -> None:
    out.print(f"\n{title}", style="bold cyan")
    columns = [Column("key", lambda row: row["key"], limit=60)]
    for title in titles:
        columns.append(Column(title, lambda row, title=title: row[title], limit=60, right=numbers))  # type: ignore[misc]
    rows = [
        {
            "key": key,
            **{title: _text(value, "+" * (title == "change")) for title, value in zip(titles, values, strict=True)},
        }
        for key, values in compared.items()
    ]
    print_table(out, columns, rows)


def _text(value: Any, sign: str = "") -> str:
    if not is_number(value):
        return "-" if value is None else str(value)
    whole = float(value).is_integer() and abs(value) < 1e15
    return f"{int(value):{sign},}" if whole else f"{value:{sign}.4g}"
