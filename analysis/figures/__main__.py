"""`qnerf figures STORE [NAME ...]`: see `--help`."""

from collections.abc import Sequence
from pathlib import Path

from .. import command
from ..style import FORMATS
from . import FIGURES
from .files import check_names, draw

WIDTH = max(map(len, FIGURES))
DESCRIPTION = "Draws figures from a store of runs:\n\n" + "\n".join(
    f"  {name:<{WIDTH}}  {entry.title}" for name, entry in FIGURES.items()
)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("figures", DESCRIPTION)
    command.add_runs(parser)
    command.add_columns(parser)
    parser.add_argument("names", nargs="*", metavar="NAME", help="figures to draw (default: all that the runs allow)")
    parser.add_argument("--out", default="figures", metavar="DIR", help="where to write (default: %(default)s)")
    parser.add_argument("--formats", default=",".join(FORMATS), metavar="png,svg,pdf")
    command.add_baseline(
        parser,
        "what forest compares with (default: the classical configuration) and stand_ins (default: the QIREN head)",
    )
    command.add_judged(parser)
    options = parser.parse_intermixed_args(arguments)
    check_names(options.names)
    look = {name: getattr(options, name) for name in ("baseline", "metric", "within")}
    draw(command.chosen(options), options.names, Path(options.out), options.formats.split(","), **look)


if __name__ == "__main__":
    command.run(main)
