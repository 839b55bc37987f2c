"""`qnerf runs [FILTER ...]`: the runs of a store, newest first."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from qnerf.cli.commands import add_store
from qnerf.cli.numbers import count as count_argument
from qnerf.cli.table import Column, Row, metric_column, print_table
from qnerf.cli.text import STATE_STYLES, age, as_json, console, count, duration, missing
from qnerf.metrics import HEAD_PARAMETERS, METRICS
from qnerf.records import filters, index
from qnerf.records.printable import ELLIPSIS, printable
from qnerf.records.schemas import is_option, is_own

MOST_OWN = 3  # results of tracked runs that are shown unasked

EPILOG = """filters (a run must match all of them):
  qcolor-hashC5              a part of the id
  field=qcolor,qboth         a column has one of the values
  state=failed               so do states
  scene.path=*fox*           patterns with * and ?
  'psnr>25'  'seed!=0'       numbers compare; quote them for the shell
Columns are those of summary.parquet: results and the flat configuration (`qnerf runs --json --all-columns`)."""


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = "Lists the runs of a store, newest first."
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("filters", nargs="*", metavar="FILTER", help="which runs; see below")
    add_store(parser)
    parser.add_argument(
        "--sort", metavar="COLUMN", default="created", help="column to sort by: numbers largest first, text from a to z"
    )
    parser.add_argument("--reverse", action="store_true", help="reverse the order")
    parser.add_argument(
        "--limit", type=count_argument, metavar="N", help="first N runs; 0: all (default: what the screen holds)"
    )
    parser.add_argument("--columns", default="", metavar="A,B", help="more columns, such as seed,train.lr")
    parser.add_argument("--all-columns", action="store_true", help="every column there is")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="one object per run, numbers in full")
    form.add_argument("--ids", action="store_true", help="only ids, one per line, for `xargs qnerf rm`")


def main(options: argparse.Namespace) -> None:
    conditions = filters.parse(options.filters)
    if store := next((condition for condition in conditions if condition.key == "store"), None):
        raise ValueError(f"{store}: the folder of runs is an option, --store {','.join(store.values)}")
    asked = [name for name in options.columns.split(",") if name]
    keys = [*(condition.key for condition in conditions), options.sort, *asked]
    everything = load(options.store, keys, options.all_columns)
    extra: list[str] = []
    sort: str = options.sort
    if len(everything):
        asked = [filters.check_column(name, everything.columns) for name in asked]
        extra = list(dict.fromkeys([*own_results(everything), *asked]))
        sort = filters.check_column(sort, everything.columns)
    frame = arrange(filters.select(everything, conditions), sort, options.reverse) if len(everything) else everything
    out = console()
    if options.json:
        print(as_json(records(limited(frame, options.limit))))
    elif options.ids:
        for name in limited(frame, options.limit).get("run_id", ()):
            print(printable(name))
    elif not len(everything):
        print(f"no runs in {printable(options.store)}")
    elif frame.empty:
        wanted = f"{' '.join(options.filters)}; {filters.there_are(everything, conditions)}"
        print(f"no run of {len(everything):,} in {printable(options.store)} has {printable(wanted)}")
    else:
        extra = [name for name in frame.columns if name not in NEEDED] if options.all_columns else extra
        print_runs(out, frame, screen(out) if options.limit is None else options.limit, extra)


def load(store: str, further: Sequence[str] = (), all_columns: bool = False) -> pd.DataFrame:
    """The store's runs with the columns of the table and those in `further`, or with every column.

    Runs that have no PSNR come with every column, of which `own_results` shows some.

    Raises:
        ValueError: no run has one of those in `further`; the message names similar ones. Or the store holds tables.
    """
    frame = index.load(store, None if all_columns else list(dict.fromkeys([*NEEDED, *further])))
    if not len(frame) and Path(store, "runs.parquet").is_file():
        raise ValueError(f"{store}: expected a folder of runs, got tables made by qnerf pack; qnerf tables reads them")
    if len(frame) and (not has_psnr(frame) or any(name not in frame for name in further)):
        frame = index.load(store)
        for name in further:
            filters.check_column(name, frame.columns)
    return frame


def own_results(frame: pd.DataFrame) -> list[str]:
    """The first results that only tracked runs have, where there is no PSNR."""
    known = ("seed", *index.RUN_COLUMNS)
    numbers = map(str, frame.select_dtypes("number"))
    own = [name for name in numbers if is_own(name) and not is_option(name) and name not in known]
    return [] if has_psnr(frame) else own[:MOST_OWN]


def has_psnr(frame: pd.DataFrame) -> bool:
    return bool("psnr" in frame and frame["psnr"].notna().any())


def arrange(frame: pd.DataFrame, sort: str = "created", reverse: bool = False) -> pd.DataFrame:
    """Numbers largest first, text from a to z, runs without a value last."""
    ascending = not pd.api.types.is_numeric_dtype(frame[sort])
    return frame.sort_values(sort, ascending=ascending != reverse, kind="stable", na_position="last")


def limited(frame: pd.DataFrame, limit: int | None) -> pd.DataFrame:
    return frame.head(limit) if limit else frame


def screen(out: Console) -> int:
    """How many runs fit on the screen with the titles, the closing line and the prompt; 0, all of them, when piped."""
    return max(out.height - 4, 5) if out.is_terminal else 0


def print_runs(out: Console, frame: pd.DataFrame, limit: int, extra: Sequence[str] = ()) -> None:
    """The table, and on a terminal a line that counts the states and the runs left out."""
    shown = records(limited(frame, limit))
    print_table(out, columns(shown, extra), shown)
    if out.is_terminal:
        out.print(counts(frame, len(shown)), style="dim", soft_wrap=True)


def counts(frame: pd.DataFrame, shown: int) -> str:
    """`12 runs: 10 finished, 2 failed`, and how many of them are not shown."""
    states = ", ".join(f"{n:,} {name}" for name, n in frame["state"].value_counts().items())
    more = f"  {ELLIPSIS} {len(frame) - shown:,} more (--limit 0 shows all)" if len(frame) > shown else ""
    return f"{count(len(frame))} runs: {states}{more}"


def columns(rows: Sequence[Row], extra: Sequence[str] = ()) -> list[Column]:
    """The usual columns that some run fills, and `extra`; errors only if a run has some."""
    usual = [column for column in COLUMNS if any(column.cell(row) != "-" for row in rows)]
    usual += [_extra(name, rows) for name in extra]
    if any(not missing(row.get("error")) for row in rows):
        usual.append(Column("error", _cell("error"), rank=6, style=lambda row: "red", limit=60))
    return usual


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """One dict per row, with None for a missing value."""
    rows = frame.to_dict("records")
    return [{str(key): None if missing(value) else value for key, value in row.items()} for row in rows]


def steps(row: Row) -> str:
    """`1,500`, or `740/1,500` for a run that is not complete."""
    step, last = row.get("step"), row.get("train.steps")
    if missing(step):
        return "-"
    return count(step) if missing(last) or step == last else f"{count(step)}/{count(last)}"


def _cell(name: str) -> Callable[[Row], str]:
    def cell(row: Row) -> str:
        value = row.get(name)
        return "-" if missing(value) else f"{value:.6g}" if isinstance(value, float) else str(value)

    return cell


def _extra(name: str, rows: Sequence[Row]) -> Column:
    """One more column under its own name; a metric in its own format."""
    if name in METRICS:
        return metric_column(METRICS[name], name, rank=2)
    numbers = all(isinstance(row.get(name), (int, float, type(None))) for row in rows)
    return Column(name, _cell(name), rank=2, right=numbers)


def _heads(row: Row) -> str:
    heads = [row[name] for name in HEAD_PARAMETERS if not missing(row.get(name))]
    return count(sum(heads)) if heads else "-"


COLUMNS = (
    Column("id", lambda row: row["run_id"], limit=255),
    Column("state", lambda row: row["state"], style=lambda row: STATE_STYLES.get(row["state"], "")),
    Column("scene_name", lambda row: "-" if row.get("scene_name") == "none" else _cell("scene_name")(row), rank=6),
    Column("field", _cell("field"), rank=1),
    Column("encoder", _cell("encoder"), rank=8),
    Column("density", _cell("density"), rank=3),
    Column("color", _cell("color"), rank=3),
    Column("params", lambda row: count(row.get("params.total")), rank=7, right=True),
    Column("heads", _heads, rank=4, right=True),
    metric_column(METRICS["psnr"], style="bold"),
    metric_column(METRICS["ssim"], rank=5),
    Column("steps", steps, right=True),
    Column("time", lambda row: duration(row.get("train_s")), rank=4, right=True),
    Column("age", lambda row: age(row.get("created")), rank=3, right=True),
)
"""`heads`: parameters of the heads, in which fields differ."""

NEEDED = (
    "run_id", "state", "error", "field", "encoder", "density", "color", "params.total", *HEAD_PARAMETERS,
    "psnr", "ssim", "scene_name", "step", "train.steps", "train_s", "created", "path",
)  # fmt: skip
