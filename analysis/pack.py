"""`python -m analysis.pack STORE FOLDER`: see `--help`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from analysis import command, packed
from analysis.load import runs

DESCRIPTION = """\
Packs the finished runs of a store into two small tables, runs.parquet and views.parquet: what every table of
analysis is made of. `python -m analysis.tables FOLDER` and the figures of runs then read that folder like a store.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m analysis.pack", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", help="folder of runs")
    parser.add_argument("folder", type=Path, help="where the two tables go; what is there is replaced")
    parser.add_argument("--filter", metavar="TEXT", help=command.HELP)
    options = parser.parse_args(arguments)
    frame = runs(options.store, options.filter)
    finished = frame[frame["state"] == "finished"]
    if finished.empty:
        raise ValueError(f"{options.store}: none of {len(frame)} runs is finished")
    left = len(frame) - len(finished)
    told = f", {left} unfinished left out" if left else ""
    print(f"{packed.pack(finished, options.folder)} runs in {options.folder}{told}")


if __name__ == "__main__":
    command.run(main)
