"""`qnerf pack STORE FOLDER`: see `--help`."""

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from qnerf.records.location import store_folder
from qnerf.records.printable import printable

from . import command, load, output, packed

DESCRIPTION = """\
Packs the runs of a store into small tables: runs.parquet, views.parquet, and for probed runs units.parquet,
cost.parquet and eval_hardware.parquet. `qnerf tables FOLDER` and most figures read the folder like a store. Pictures,
curves and other probes are not packed: `qnerf figures STORE loss --out FOLDER` draws what needs them.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("pack", DESCRIPTION)
    command.add_runs(parser)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the tables go; earlier ones are replaced")
    parser.add_argument("--add", action="store_true", help="keep the other runs that FOLDER has")
    options = parser.parse_args(arguments)
    if options.folder.resolve() == store_folder(options.store).resolve():
        raise ValueError(f"{options.folder}: expected a folder of its own, this is one of runs")
    frame = command.chosen(options)
    unfinished = int((frame["state"] != "finished").sum())
    if unfinished == len(frame):
        raise ValueError(f"{options.store}: no run of {unfinished} is finished")
    if options.add and packed.is_packed(options.folder):
        frame = with_earlier(frame, options.folder)
    output.make_folder(options.folder, store=False)
    finished, problems = packed.pack(frame, options.folder)
    for problem in problems:
        print(f"left out: {printable(problem)}", file=sys.stderr)
    print(f"{finished} runs{f' finished, {unfinished} not' if unfinished else ''}, in {options.folder}")


def with_earlier(frame: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """The runs, and those packed in the folder that are not among them."""
    earlier = load.runs(folder)
    parts = [frame, earlier[~earlier["run_id"].isin(frame["run_id"])]]
    joined = pd.concat([part.dropna(axis=1, how="all") for part in parts], ignore_index=True)
    empty = frame.columns.union(earlier.columns, sort=False).difference(joined.columns, sort=False)
    # pandas refuses to guess the kind of empty columns in `concat`.
    return pd.concat([joined, pd.DataFrame(None, joined.index, empty, dtype=object)], axis=1)


if __name__ == "__main__":
    command.run(main)
