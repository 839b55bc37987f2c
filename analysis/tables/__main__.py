"""`qnerf tables STORE`: see `--help`."""

from collections.abc import Sequence

from qnerf.cli.numbers import number
from qnerf.metrics import METRICS

from .. import command
from ..paper import PAPER_TABLES
from .ablation import ablation
from .resources import RATE, resources
from .scenes import across_scenes
from .smallest import smallest
from .stability import stability
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
  {} runs --rows field,hash --smallest --within 0.5 --size step_ms
  {} runs --rows scene_name,field --stability
  {} runs --rows scene_name,field --baseline field=classical --resources --rate 1000 --format latex
  {} runs --paper rgb --filter scene_name=poster
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("tables", DESCRIPTION, EXAMPLES)
    command.add_runs(parser)
    command.add_format(parser)
    parser.add_argument(
        "--rows",
        default="scene_name,field,color",
        metavar="KEY,...",
        help="columns that distinguish the rows: any key of the configuration (color.qiren.spectral) or a short name "
        "(field, density, color, hash, qiren, train); default: %(default)s",
    )
    parser.add_argument(
        "--values",
        metavar="NAME,...",
        help=f"columns to show; default: the metrics that the runs have, of {', '.join(METRICS)}",
    )
    parser.add_argument("--metric", default="psnr", help="column that ranks the runs; default: %(default)s")
    command.add_baseline(
        parser,
        "compare each row with this one: the difference with its interval, and the verdict: better, worse, "
        "equivalent or undecided",
    )
    parser.add_argument(
        "--smallest", "--needs", action="store_true", help="instead: the smallest row within the tolerance of the best"
    )
    parser.add_argument(
        "--across-scenes",
        action="store_true",
        help="instead: differences from --baseline on each scene, and over these scenes and scenes like them",
    )
    parser.add_argument(
        "--stability", action="store_true", help="instead: the worst seed of each row, and how many fail"
    )
    parser.add_argument(
        "--units",
        action="store_true",
        help="instead: dead units and the spread of colours, of runs that `qnerf probe RUN units` probed",
    )
    parser.add_argument(
        "--resources",
        action="store_true",
        help="instead of all metrics: quality, parameters, time and memory, and what `qnerf probe RUN cost` and `qnerf "
        "probe RUN shots=100 noise=...` found: gates, depth, device hours, PSNR with finite shots and noisy gates",
    )
    parser.add_argument(
        "--within",
        type=number(0, 1e9, above=True),
        metavar="DELTA",
        help="smallest difference that matters, in the metric's unit, for verdicts and --smallest; default: 0.5 dB",
    )
    parser.add_argument(
        "--size",
        default="params.total",
        help="for --smallest: the column to minimise, such as step_ms; default: %(default)s",
    )
    parser.add_argument(
        "--rate",
        type=number(0, 1e12, above=True),
        default=RATE,
        help="for --resources: shots that a device takes in a second; default: %(default)s",
    )
    titles = "; ".join(f"{key}: {title}" for key, (title, _) in PAPER_TABLES.items())
    parser.add_argument(
        "--paper", choices=PAPER_TABLES, help=f"instead: a table of the paper with ours beside it. {titles}"
    )
    options = parser.parse_args(arguments)
    frame = command.chosen(options)
    rows = options.rows.split(",")
    if options.paper:
        table = PAPER_TABLES[options.paper][1](frame)
    elif options.smallest:
        table = smallest(frame, rows, metric=options.metric, within=options.within, size=options.size)
    elif options.across_scenes:
        if options.baseline is None:
            raise ValueError("--across-scenes needs --baseline KEY=VALUE,...")
        table = across_scenes(frame, rows, options.baseline, metric=options.metric, within=options.within)
    elif options.stability:
        if options.metric != "psnr":
            raise ValueError(f"--stability counts dB of psnr, got --metric {options.metric}")
        table = stability(frame, rows)
    elif options.units:
        table = units(frame, rows)
    elif options.resources:
        table = resources(
            frame, rows, metric=options.metric, baseline=options.baseline, within=options.within, rate=options.rate
        )
    else:
        values = options.values.split(",") if options.values else None
        table = ablation(
            frame, rows, metric=options.metric, values=values, baseline=options.baseline, within=options.within
        )
    command.show(table, options.format)


if __name__ == "__main__":
    command.run(main)
