"""`python -m analysis.pack STORE FOLDER`: see `--help`."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from . import command, packed
from .figures import FIGURES
from .figures.files import check_names, draw, title
from .load import runs
from .paper import PAPER_TABLES

DESCRIPTION = """\
Packs the runs of a store into small tables: runs.parquet, views.parquet, and where runs were probed units.parquet and
eval_hardware.parquet. They are what every table of analysis is made of; `python -m analysis.tables FOLDER` and the
figures of runs read that folder like a store. What needs the runs' pictures, curves or other probes is drawn at once:
--figures, --paper.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m analysis.pack", description=DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", help="folder of runs")
    parser.add_argument("folder", type=Path, help="where the tables go; what is there is replaced")
    parser.add_argument("--filter", metavar="TEXT", help=command.HELP)
    parser.add_argument("--figures", nargs="+", default=[], metavar="NAME", help=f"kept as PNG: {', '.join(FIGURES)}")
    parser.add_argument("--paper", choices=PAPER_TABLES, help="a table of the paper beside ours, kept as Markdown")
    options = parser.parse_args(arguments)
    check_names(options.figures)
    if options.folder.resolve() == Path(options.store).resolve():
        raise ValueError(f"{options.folder}: expected a folder of its own, this is one of runs")
    frame = runs(options.store, options.filter)
    left = len(frame) - int((frame["state"] == "finished").sum())
    if left == len(frame):
        raise ValueError(f"{options.store}: none of {left} runs is finished")
    told = f" finished, {left} not" if left else ""
    for file in [*options.folder.glob("*.png"), *options.folder.glob("*.md")]:
        if title(file.stem) != file.stem or file.stem in PAPER_TABLES:
            file.unlink()  # drawn of the runs that were there
    print(f"{packed.pack(frame, options.folder)} runs{told}, in {options.folder}")
    if options.figures:
        draw(frame, options.figures, options.folder, ["png"])
    if options.paper:
        heading, table = PAPER_TABLES[options.paper]
        (options.folder / f"{options.paper}.md").write_text(f"**{heading}**\n\n{table(frame).markdown()}\n")


if __name__ == "__main__":
    command.run(main)
