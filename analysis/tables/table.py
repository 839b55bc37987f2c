"""One table, written as Markdown, LaTeX (booktabs) or CSV.

pandas' Styler escapes neither `[` and `*` after the end of a LaTeX row nor `|` in Markdown, so cells are escaped here.
"""

import itertools
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

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
    """`text` is what is shown, a cell a string; `bold` has its shape; `data` are the numbers behind it, a row a row."""

    title: str
    text: pd.DataFrame
    data: pd.DataFrame
    bold: pd.DataFrame
    notes: tuple[str, ...] = ()

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
        table = Table(self.title, self.text[shown], self.data, self.bold[shown], self.notes)
        numbers = [_is_numeric(table.text[name]) for name in shown]
        lines = [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{latex_escape(self.title)}}}",
            rf"\label{{tab:{_slug(self.title)}}}",
            rf"\begin{{tabular}}{{{''.join('r' if number else 'l' for number in numbers)}}}",
            r"\toprule",
            *_latex_heads(shown),
            r"\midrule",
            *(" & ".join(row) + r" \\" for row in table._rows(_latex_cell, r"\textbf{{{}}}")),
            r"\bottomrule",
            r"\end{tabular}",
            *(rf"\par\footnotesize {latex_escape(note)}" for note in self.notes),
            r"\end{table}",
        ]
        return "\n".join(lines)

    def csv(self) -> str:
        """The numbers in full, one column each (`psnr_mean`, `psnr_std`, `psnr_n`), without title and notes."""
        flat = self.data.reset_index() if self.data.index.names != [None] else self.data
        flat.columns = ["_".join(filter(None, map(str, _parts(name)))) for name in flat.columns]
        shown = flat.map(lambda value: printable(value) if isinstance(value, str) else value)
        return shown.to_csv(index=False, lineterminator="\n").rstrip("\n")

    def _rows(self, escape: Callable[[str], str], emphasis: str) -> list[list[str]]:
        return [
            [emphasis.format(escape(cell)) if bold else escape(cell) for cell, bold in zip(cells, marks, strict=True)]
            for cells, marks in zip(self.text.to_numpy(), self.bold.to_numpy(), strict=True)
        ]


def _latex_heads(names: Sequence[str]) -> list[str]:
    """The lines of headings: one, or two where some have a part before a colon in common."""
    groups = [(key, list(own)) for key, own in itertools.groupby(names, lambda name: name.rpartition(": ")[0])]
    groups = [
        part for key, own in groups for part in ([(key, own)] if key and own[1:] else [("", [one]) for one in own])
    ]
    if not any(key for key, _ in groups):
        return [" & ".join(map(latex_escape, names)) + r" \\"]
    above, rules, below, column = [], [], [], 1
    for key, own in groups:
        above.append(rf"\multicolumn{{{len(own)}}}{{c}}{{{latex_escape(key)}}}" if key else "")
        rules += [rf"\cmidrule(lr){{{column}-{column + len(own) - 1}}}"] if key else []
        below += [latex_escape(name.rpartition(": ")[2] if key else name) for name in own]
        column += len(own)
    return [" & ".join(above) + r" \\", " ".join(rules), " & ".join(below) + r" \\"]


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


def _is_numeric(column: pd.Series) -> bool:
    return bool(column.str.fullmatch(r"[-+\d,.]*( .*)?").all())


def _parts(name: object) -> tuple[object, ...]:
    return name if isinstance(name, tuple) else (name,)
