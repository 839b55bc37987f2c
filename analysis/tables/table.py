"""One table, written as Markdown, LaTeX (booktabs) or CSV.

pandas' Styler escapes neither `[` and `*` after the end of a LaTeX row nor `|` in Markdown, so cells are escaped here.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import pandas as pd

from qnerf.records.printable import printable

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "{": r"\{",
        "}": r"\}",
        "$": r"\$",
        "&": r"\&",
        "#": r"\#",
        "_": r"\_",
        "%": r"\%",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "[": "{[}",  # after the end of a row, [ and * would be taken for an argument
        "]": "{]}",
        "*": "{*}",
        "±": r"$\pm$",
    }
)
_MARKDOWN = str.maketrans({"\\": r"\\", "|": r"\|", "`": r"\`"})
# A star between spaces is a star, < before anything but the start of a tag is less-than, and brackets are links only
# before one of ( [ :
_MARKUP = re.compile(r"\*(?=\S)|(?<=\S)\*|<(?=[A-Za-z/!?])|\](?=[(\[:])")

_MINUS = re.compile(r"(?<![\w.,)-])-(?=\.?\d)")
"""The hyphen of a negative number, not that of a range, a date or a name."""


@dataclass(frozen=True)
class Table:
    """`text` is what is shown, a cell a string; `data` are the numbers behind it, a row a row.

    bold: which cells are bold, where any of a column is. Empty notes are left out.
    """

    title: str
    text: pd.DataFrame
    data: pd.DataFrame
    bold: pd.DataFrame = field(default_factory=pd.DataFrame)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        whole = self.bold.reindex(index=self.text.index, columns=self.text.columns, fill_value=False)
        object.__setattr__(self, "bold", whole)
        object.__setattr__(self, "notes", tuple(filter(None, self.notes)))

    def markdown(self) -> str:
        """A table of GitHub's Markdown; the notes are paragraphs under it."""
        head = [markdown_escape(name) for name in self.text.columns]
        lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
        lines += ["| " + " | ".join(row) + " |" for row in self._rows(markdown_escape, "**{}**")]
        lines += [f"\n{markdown_escape(note)}" for note in self.notes]
        return "\n".join(lines)

    def latex(self) -> str:
        """A `table` environment with a label; needs the package booktabs.

        Columns without any text are left out, but not the first. Headings `A: b` and `A: c` side by side share A.
        """
        first = self.text.columns[0]
        shown = [name for name in self.text.columns if name == first or (self.text[name] != "").any()]
        table = replace(self, text=self.text[shown])
        groups = [str(name).rpartition(": ")[0] for name in shown]
        heads = [
            (group, name.removeprefix(f"{group}: ")) if group and groups.count(group) > 1 else ("", name)
            for group, name in zip(groups, shown, strict=True)
        ]
        cells = pd.DataFrame(table._rows(_latex_cell, r"\textbf{{{}}}"))
        escaped = pd.MultiIndex.from_tuples([tuple(map(latex_escape, head)) for head in heads])
        cells.columns = escaped if any(group for group, _ in heads) else escaped.get_level_values(1)
        text = cells.style.hide(axis="index").to_latex(
            caption=latex_escape(self.title), label=f"tab:{_slug(self.title)}", position_float="centering", hrules=True,
            column_format="".join("r" if number else "l" for number in table.numeric()), multicol_align="c",
        )  # fmt: skip
        notes = "".join(f"\\par\\footnotesize {latex_escape(note)}\n" for note in self.notes)
        return text.removesuffix("\\end{table}\n") + notes + r"\end{table}"

    def csv(self) -> str:
        """The numbers in full, one column each (`psnr_mean`, `psnr_std`, `psnr_n`), without title and notes."""
        flat = self.data.reset_index() if self.data.index.names != [None] else self.data
        flat.columns = ["_".join(filter(None, map(str, _parts(name)))) for name in flat.columns]
        shown = flat.map(lambda value: printable(value) if isinstance(value, str) else value)
        return shown.to_csv(index=False, lineterminator="\n").rstrip("\n")

    def numeric(self) -> list[bool]:
        """Which columns hold numbers, with their spreads and counts, alone."""
        return [bool(column.str.fullmatch(r"[-+\d.,\s±()n=\[\]*]*").all()) for _, column in self.text.items()]

    def _rows(self, escape: Callable[[str], str], emphasis: str) -> list[list[str]]:
        return [
            [emphasis.format(escape(cell)) if bold else escape(cell) for cell, bold in zip(cells, marks, strict=True)]
            for cells, marks in zip(self.text.to_numpy(), self.bold.to_numpy(), strict=True)
        ]


def _latex_cell(text: str) -> str:
    return _MINUS.sub("$-$", latex_escape(text))


def _slug(text: str) -> str:
    return "-".join(re.findall(r"[a-z0-9]+", text.lower()))


def latex_escape(text: str) -> str:
    return _one_line(text).translate(_LATEX)


def markdown_escape(text: str) -> str:
    return _MARKUP.sub(r"\\\g<0>", _one_line(text).translate(_MARKDOWN))


def _one_line(text: str) -> str:
    return printable(" ".join(text.splitlines()))


def _parts(name: object) -> tuple[object, ...]:
    return name if isinstance(name, tuple) else (name,)
