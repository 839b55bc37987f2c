"""`python -m docs.tools.paper TABLE STORE`: a table of the paper with our runs beside it."""

import argparse
from collections.abc import Sequence

from qnerf.analysis import command

from .tables import PAPER_TABLES


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    titles = "; ".join(f"{key}: {title}" for key, (title, _) in PAPER_TABLES.items())
    parser.add_argument("table", choices=PAPER_TABLES, help=titles)
    command.add_runs(parser)
    command.add_format(parser)
    options = parser.parse_args(arguments)
    command.show(PAPER_TABLES[options.table][1](command.chosen(options)), options.format)


if __name__ == "__main__":
    command.run(main)
