"""The page docs/results.md: a section per question, made from packed runs.

`qnerf results docs/results --write docs/results.md` writes it. `qnerf pack` packs the runs of
each question into a folder of its own.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from qnerf.records.files import read_bytes
from qnerf.records.parquet import reading
from qnerf.records.printable import printable

from . import command, load, output
from .figures.files import title
from .question import Question
from .questions import QUESTIONS

HEAD = """\
# Results

`qnerf results docs/results --write docs/results.md` makes every table from the runs in `docs/results/`,
which has a folder per question. Each section begins with the commands that trained its runs, followed by those that
make its tables from the stored runs. Give the latter other `--rows` to group the runs differently.

PSNR and SSIM are means over the held-out views, 5 of `fox_64` and 22 of `poster`, at the end of training. The training
commands are those of `poster`; add `scene=nerfstudio scene.path=DIR` for `fox_64`, which is the fox capture of
instant-ngp at 36 x 64. Commands with `density.mlp.init=torch` reproduce runs from before `train=quick` gave MLPs
He initialisation. Runs of `train=quick` are from before it halved the samples of the proposal networks, which changes
no PSNR (see the question about them); `proposal.samples=[128,64]` repeats them.
`qnerf pack runs docs/results/NAME --figures FIGURE` draws a figure from the store of runs.

The runs of a table were not all trained at the same time, so compare step times with `python -m benchmarks.training`
instead. {hardware}
"""

MAX_TEXT_BYTES = 2**20


def page(folder: Path) -> str:
    """The page in Markdown, a section for each question whose folder exists; hardware.txt describes the machine.

    Raises:
        ValueError: there is no folder of packed runs, or one that belongs to no question.
    """
    present = {path.parent.name for path in folder.glob("*/runs.parquet")}
    unknown = sorted(present - set(QUESTIONS))
    if not present or unknown:
        raise ValueError(
            f"{folder}: expected folders of packed runs, among {', '.join(QUESTIONS)}; "
            f"got {', '.join(unknown) or 'none'}"
        )
    file = folder / "hardware.txt"
    parts = [HEAD.format(hardware=read_text(file) if file.is_file() else "").rstrip()]
    for name, question in QUESTIONS.items():
        if name in present:
            parts += section(name, question, load.runs(folder / name)) + stored(folder / name)
    return "\n\n".join(parts) + "\n"


def stored(folder: Path) -> list[str]:
    """What `qnerf pack` made from parts of the runs that it does not pack: tables of the paper and figures."""
    tables = [read_text(file) for file in sorted(folder.glob("*.md"))]
    pictures = [
        f"![{title(file.stem)}]({folder.parent.name}/{folder.name}/{file.name})"
        for file in sorted(folder.glob("*.png"))
    ]
    return tables + pictures


def read_text(file: Path) -> str:
    """A small text file without control characters; StoreError if it is a link, large, or not UTF-8."""
    with reading(file):
        text = read_bytes(file, MAX_TEXT_BYTES).decode()
    return printable("\n".join(text.splitlines()), lines=True).strip()


def section(name: str, question: Question, frame: pd.DataFrame) -> list[str]:
    """The paragraphs of a question: commands, number of runs, tables."""
    steps = frame.groupby("train")["train.steps"].unique()
    budgets = "; ".join(
        f"`train={recipe}`, {', '.join(f'{n:,}' for n in sorted(numbers))} steps" for recipe, numbers in steps.items()
    )
    seeds = ", ".join(map(str, sorted(frame["seed"].unique())))
    commands = "\n".join(f"    {line}" for line in (*question.commands, *question.table_commands(name)))
    tables = [f"**{table.title}**\n\n{table.markdown()}" for table in question.tables(frame)]
    return [f"## {question.title}", commands, f"{len(frame)} runs; {budgets}; seeds {seeds}.", *tables]


DESCRIPTION = """\
Writes the page of results, docs/results.md: one section a question, made from folders of packed runs named after it.
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = command.parser("results", DESCRIPTION)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder of folders that `qnerf pack` wrote")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the page here (default: standard output)")
    options = parser.parse_args(arguments)
    text = page(options.folder)
    if options.write:
        output.write(options.write, text.encode())
    else:
        sys.stdout.write(text)


if __name__ == "__main__":
    command.run(main)
