"""`qnerf tables STORE`: see `--help`."""

from collections.abc import Callable, Sequence
from inspect import signature

from qnerf.cli.numbers import number
from qnerf.metrics import METRICS
from qnerf.records import filters

from .. import command
from ..selection import main_metric, row_keys, select
from .ablation import ablation
from .resources import RATE, resources
from .scenes import across_scenes
from .stability import stability
from .table import Table
from .units import units

DESCRIPTION = """\
Tables over seeds from a folder of runs. A row is a group of finished runs that differ only in their seed: mean ±
standard deviation, the best of each scene in bold. Unfinished, failed and damaged runs, and runs without the metric,
are counted under the table. A row that would mix scenes or configurations is refused with the keys that differ.
"""
EXAMPLES = """\
  {} runs
  {} runs --rows field,qiren --filter scene_name=poster
  {} runs --rows scene_name,field --baseline field=classical --format latex
  {} runs --rows scene_name,field --baseline field=classical --across-scenes
  {} runs --rows scene_name,field --stability
  {} runs --rows scene_name,field --baseline field=classical --resources --rate 1000 --format latex
  {} results.csv --baseline model=forest --within 0.01
"""

OPTIONS = ("values", "metric", "baseline", "within", "rate")
INSTEAD: dict[str, tuple[Callable[..., Table], str]] = {
    "across-scenes": (
        across_scenes,
        "differences from --baseline on each scene, and over these scenes and scenes like them",
    ),
    "stability": (stability, "the worst seed of each row, and how many fail"),
    "units": (units, "dead units and the spread of colours, of runs that `qnerf probe RUN units` probed"),
    "resources": (
        resources,
        "quality, parameters, time and memory, and what `qnerf probe RUN cost` and `qnerf probe RUN shots=100 "
        "noise=...` found: gates, depth, device hours, PSNR with finite shots and noisy gates",
    ),
}
"""Option -> the function that makes the table, and what it shows."""


def words(text: str) -> list[str]:
    return text.split(",")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("tables", DESCRIPTION, EXAMPLES)
    command.add_runs(parser)
    command.add_columns(parser)
    command.add_format(parser)
    parser.add_argument(
        "--rows",
        type=words,
        metavar="KEY,...",
        help="columns that distinguish the rows: any key of the configuration (color.qiren.spectral) or a short name "
        "(field, density, color, hash, qiren, train); default: all that differ",
    )
    parser.add_argument(
        "--values",
        type=words,
        metavar="NAME,...",
        help=f"columns to show; default: the metrics that the runs have, of {', '.join(METRICS)}",
    )
    command.add_baseline(
        parser,
        "compare each row with this one: the difference with its interval, and the verdict: better, worse, "
        "equivalent or undecided",
    )
    command.add_judged(parser)
    parser.add_argument(
        "--rate",
        type=number(0, 1e12, above=True),
        help=f"for --resources: shots that a device takes in a second; default: {RATE:g}",
    )
    tables = parser.add_mutually_exclusive_group()
    for name, (make, what) in INSTEAD.items():
        tables.add_argument(f"--{name}", action="store_const", dest="make", const=make, help=f"instead: {what}")
    options = parser.parse_args(arguments)
    make = options.make or ablation
    known = signature(make).parameters
    given = {name: value for name in OPTIONS if (value := getattr(options, name)) is not None}
    if unused := [f"--{name}" for name in given if name not in known]:
        raise ValueError(f"{', '.join(unused)}: without effect on this table")
    frame = command.chosen(options)
    metric = options.metric or main_metric(frame)
    if "metric" in known:
        given["metric"] = metric
    if "rows" in known:
        keys = options.rows or row_keys(select(frame, metric).runs)
        given["rows"] = [filters.check_column(key, frame.columns) for key in keys]
    if options.values:
        given["values"] = [filters.check_column(name, frame.columns) for name in options.values]
    table = make(frame, **given)
    command.show(table, options.format)


if __name__ == "__main__":
    command.run(main)
