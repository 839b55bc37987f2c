"""`qnerf pack STORE FOLDER` or `python -m analysis.pack`: see `--help`."""

import sys
from collections.abc import Sequence
from pathlib import Path

from qnerf.records.printable import printable

from . import command, packed
from .figures import FIGURES
from .figures.files import check_names, draw, title
from .paper import PAPER_TABLES

DESCRIPTION = """\
Packs the runs of a store into small tables: runs.parquet, views.parquet, and for probed runs units.parquet and
eval_hardware.parquet. `qnerf tables FOLDER` and most figures read the folder like a store. Pictures, curves and other
probes are not packed: --figures draws what needs them now, --paper writes a table of the paper.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("pack", DESCRIPTION)
    command.add_runs(parser)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where the tables go; earlier ones are replaced")
    parser.add_argument("--figures", nargs="+", default=[], metavar="NAME", help=f"draw as PNG: {', '.join(FIGURES)}")
    parser.add_argument("--paper", choices=PAPER_TABLES, help="write a table of the paper beside ours as Markdown")
    options = parser.parse_args(arguments)
    check_names(options.figures)
    if options.folder.resolve() == Path(options.store).resolve():
        raise ValueError(f"{options.folder}: expected a folder of its own, this is one of runs")
    frame = command.chosen(options)
    unfinished = int((frame["state"] != "finished").sum())
    if unfinished == len(frame):
        raise ValueError(f"{options.store}: none of {unfinished} runs is finished")
    for file in [*options.folder.glob("*.png"), *options.folder.glob("*.md")]:
        if title(file.stem) != file.stem or file.stem in PAPER_TABLES:
            file.unlink()  # made from the runs that were packed before
    finished, problems = packed.pack(frame, options.folder)
    for problem in problems:
        print(f"left out: {printable(problem)}", file=sys.stderr)
    print(f"{finished} runs{f' finished, {unfinished} not' if unfinished else ''}, in {options.folder}")
    if options.figures:
        draw(frame, options.figures, options.folder, ["png"])
    if options.paper:
        heading, table = PAPER_TABLES[options.paper]
        (options.folder / f"{options.paper}.md").write_text(
            f"**{heading}**\n\n{table(frame).markdown()}\n", encoding="utf-8"
        )


if __name__ == "__main__":
    command.run(main)
