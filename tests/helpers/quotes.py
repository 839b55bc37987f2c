"""Checks that a number in a document is in the row that it is quoted from.

The writer names the rows in an HTML comment after the numbers:

    ... by 0.28 ± 0.17 dB. <!-- results rates: fox_64 0.33 - 1 -->

`rates` is the page docs/results/rates/README.md. The words pick one row of its tables: a scene and the keys of a row.
` - ` and the words of another row ask for the difference of the two. Several rows are separated by `;`, in the order of
their numbers. A comment covers the numbers since the comment before it, or since the start of its paragraph, list item
or table row.

`<!-- each row, results recipe: fox_64 {2} - quick_recipe -->` above a table covers every row without a comment of its
own; {2} stands for the second cell of the row.

Other sources: `<!-- from FILE.parquet: qcolor & threads 2 -->` picks the row of a parquet file whose text has these
parts. `<!-- measured at COMMIT -->` and `<!-- quoted from SOURCE -->` are for numbers that no file holds.
`<!-- checked by TEST -->` names a test in tests/test_documents.py.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import pandas as pd

from tests.helpers.configs import ROOT

NUMBER = r"[+-]?\d[\d,]*(?:\.\d+)?"
MEAN = r"[+-]?\d+\.\d+ ± \d+\.\d+"
"""A mean and its standard deviation, or a difference and the reach of its interval."""
INTERVAL = rf"{NUMBER} \[{NUMBER}, {NUMBER}\]"
DECIMAL = r"(?<![\w.:])[+-]?\d+\.\d+(?:e[+-]\d+)?"
QUOTE = rf"{INTERVAL}|{MEAN}|{DECIMAL}"
MEASURED = r"|(?<![\w.])\d+(?= (?:ms|s|%)(?:[ ,.|]|$))|(?<=\| )\d+(?= *$)"
"""Whole numbers that were measured: with a unit, or at the end of a table's row."""
PERCENT = r"|(?<![\w.])\d+(?= %)"
MUST = re.compile(rf"{INTERVAL}|{MEAN}|\d\.\d+ dB\b")
"""What may not stand in a document without a source."""
COMMENT = re.compile(r"<!-- (results|from|measured at|quoted from|checked by) (.*?) ?-->", re.DOTALL)
EACH_ROW = re.compile(r"<!-- each row, (results|from|measured at|quoted from|checked by) (.*?) ?-->\n", re.DOTALL)
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


Holds = Callable[[str], bool]
"""Whether a row has a quoted number."""


@dataclass
class Row:
    """A row of a table: the words that name it, its numbers with the decimals they have, its mean ± deviation, and its
    differences, each with the words of what it is the difference from."""

    words: Counter[str]
    numbers: list[str] = field(default_factory=list)
    means: list[str] = field(default_factory=list)
    differences: list[tuple[Counter[str], str]] = field(default_factory=list)


def problems(text: str, tables: dict[str, list[list[Row]]], root: Path = ROOT) -> list[str]:
    """One line for each number of a Markdown document that is not in the row that it names, or that names none."""
    lines = []
    for block, template in blocks(FENCE.sub("", text)):
        for span, kind, source in spans(block, template):
            if kind == "":
                lines += [f"{number!r}: no source" for number in MUST.findall(plain(span))]
            elif kind == "results":
                lines += ordered(quoted(span, PERCENT), source, lambda one: result_row(one, tables))
            elif kind == "from":
                file, _, picked = source.partition(": ")
                lines += ordered(quoted(span, MEASURED), picked, lambda one, file=file: parquet_row(root / file, one))
    return lines


def blocks(text: str) -> Iterator[tuple[str, str]]:
    """Paragraphs, list items and table rows, each with the comment that speaks for every row of its table."""
    for part in re.split(r"\n\s*\n|\n(?=\s*(?:- |\d+\. ))", text):
        if part.startswith("    ") and not part.lstrip().startswith(("- ", "<!--")):
            continue  # commands
        match = EACH_ROW.search(part)
        template = f"<!-- {match[1]} {match[2]} -->" if match else ""
        rest = EACH_ROW.sub("", part)
        if rest.lstrip().startswith("|"):
            yield from ((line, template) for line in rest.strip().splitlines()[2:])
        else:
            yield rest, ""


def spans(block: str, template: str) -> Iterator[tuple[str, str, str]]:
    """Text, kind of its source, source; of text after the last comment both are empty."""
    if template and not COMMENT.search(block):
        cells = [re.sub(r"[`*]", "", cell).strip() for cell in block.strip().strip("|").split("|")]
        block += re.sub(r"\{(\d+)\}", lambda match: cells[int(match[1]) - 1], template)
    end = 0
    for match in COMMENT.finditer(block):
        yield block[end : match.start()], match[1], " ".join(match[2].split())
        end = match.end()
    yield block[end:], "", ""


def plain(text: str) -> str:
    """Without code, emphasis and line breaks."""
    return " ".join(re.sub(r"`[^`]*`", "", text).replace("**", "").split())


def quoted(text: str, more: str = "") -> list[str]:
    return re.findall(QUOTE + more, plain(text))


def ordered(numbers: Sequence[str], source: str, row_of: Callable[[str], Holds]) -> list[str]:
    """Each number is in the row that it stands for, which is that of the number before it or the next one."""
    names = [one.strip() for one in source.split(";")]
    try:
        holds = [row_of(name) for name in carried(names)]
    except LookupError as error:
        return [str(error.args[0])]
    at, used = 0, set()
    for number in numbers:
        hit = next((i for i in range(at, len(names)) if holds[i](number)), None)
        if hit is None:
            return [f"{number!r} is not in {'; '.join(names[at:])}"]
        at = hit
        used.add(hit)
    return [f"no number is from {names[i]!r}" for i in range(len(names)) if i not in used]


def carried(names: Sequence[str]) -> list[str]:
    """`seeds: a`, `b` -> `seeds: a`, `seeds: b`."""
    section, full = "", []
    for name in names:
        head, colon, rest = name.partition(": ")
        section = head if colon else section
        full.append(f"{section}: {rest if colon else name}" if section else name)
    return full


def result_row(name: str, tables: dict[str, list[list[Row]]]) -> Holds:
    """Whether a quoted number is in the row, or is the difference, that `SECTION: WORDS [- WORDS]` names."""
    section, _, words = name.partition(": ")
    if section not in tables:
        raise LookupError(f"no page docs/results/{section}/README.md")
    first, minus, second = words.partition(" - ")
    if not minus:
        rows = matching(tables[section], Counter(first.casefold().split()), name)
        return lambda number: any(is_in(number, row) for row in rows)
    scene, *a = first.casefold().split()
    b = second.casefold().split()
    rows = [row for table in tables[section] for row in table]
    shown = {
        text
        for row in rows
        if Counter([scene, *a]) <= row.words
        for base, text in row.differences
        if base == Counter(b)
    }
    back = {
        text
        for row in rows
        if Counter([scene, *b]) <= row.words
        for base, text in row.differences
        if base == Counter(a)
    }
    found = {values(text) for text in shown} | {(-mean, reach) for mean, reach in map(values, back)}
    if len(found) != 1 and a != b:
        raise LookupError(f"{name!r} names {len(found)} differences of the page {section}")
    alone = result_row(f"{section}: {first}", tables)
    return lambda number: ("±" in number and values(number) in found) or alone(number)


def matching(section: list[list[Row]], words: Counter[str], name: str) -> list[Row]:
    """The row of each table that has all the words; LookupError where none has, or several different ones do."""
    result = []
    for table in section:
        rows = [row for row in table if words <= row.words]
        if any(row != rows[0] for row in rows):
            raise LookupError(f"{name!r} names several rows of its page")
        result += rows[:1]
    if not result:
        raise LookupError(f"{name!r} names no row of its page")
    return result


def is_in(number: str, row: Row) -> bool:
    if "±" in number:
        return number in row.means
    return any(agrees(number, value) for value in row.numbers)


def agrees(number: str, value: str) -> bool:
    """Whether `number` is `value`, rounded to the decimals of `number`; `value` may be rounded itself."""
    decimals, known = len(number.partition(".")[2]), len(value.partition(".")[2])
    return known >= decimals and abs(float(number) - float(value)) <= 0.5 * 10**-decimals + 0.5 * 10**-known * (
        known > decimals
    )


def values(text: str) -> tuple[float, ...]:
    return tuple(float(number) for number in re.findall(r"[+-]?\d+\.\d+", text))


def parquet_row(file: Path, phrases: str) -> Holds:
    """Whether a number is a value, rounded, of the one row of a parquet file whose text has all phrases."""
    rows = [numbers for text, numbers in parquet_rows(file) if all(phrase in text for phrase in phrases.split(" & "))]
    if len(rows) != 1:
        raise LookupError(f"{phrases!r} names {len(rows)} rows of {file.name}")

    def holds(quote: str) -> bool:  # a number, or those of an interval
        parts = re.findall(NUMBER, quote)
        return all(any(round(value, len(n.partition(".")[2])) == float(n) for value in rows[0]) for n in parts)

    return holds


@cache
def parquet_rows(file: Path) -> list[tuple[str, list[float]]]:
    """Text of a row, without its measured numbers; its measured numbers."""
    frame = pd.read_parquet(file)
    measured = frame.select_dtypes("floating")
    words = frame.drop(columns=measured.columns).to_dict("records")
    texts = [" ".join(f"{key} {value}" for key, value in row.items()) + " " for row in words]
    return list(zip(texts, measured.to_numpy().tolist(), strict=True))


@cache
def results() -> dict[str, list[list[Row]]]:
    """The tables of each page of results."""
    pages = (ROOT / "docs" / "results").glob("*/README.md")
    return {page.parent.name: result_tables(page.read_text()) for page in pages}


def result_tables(page: str) -> list[list[Row]]:
    return [result_rows(table) for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)]


MEASURES = re.compile(r"(?:(.+): )?((?:PSNR|exact|KS|distance error|against).*)")
"""The heading of a measured column: `fox_64: PSNR, dB`, `against classical`."""


def result_rows(table: str) -> list[Row]:
    """The rows of a table; where it has columns of several scenes, one for each of them."""
    header, _, *lines = [
        [cell.strip() for cell in line.strip().strip("|").split("|")] for line in table.strip().splitlines()
    ]
    start = next((i for i, name in enumerate(header) if MEASURES.fullmatch(name)), len(header))
    scenes = list(dict.fromkeys(match[1] for name in header[start:] if (match := MEASURES.fullmatch(name))))
    rows = []
    for cells in lines:
        cells = [cell.replace("**", "") for cell in cells]
        for scene in scenes:
            row = Row(words(", ".join(cells[:start])) + Counter([scene.casefold()] if scene else []))
            for name, cell in zip(header[start:], cells[start:], strict=True):
                match = MEASURES.fullmatch(name)
                if match is None or match[1] == scene:
                    add(row, match[2] if match else name, cell)
            rows.append(row)
    return rows


def words(text: str) -> Counter[str]:
    """Of cells with commas between them; a list is one word."""
    return Counter(cell.replace(", ", ",") for cell in re.split(r", (?![^\[]*\])", text.casefold()))


def add(row: Row, heading: str, cell: str) -> None:
    """Adds what a cell holds to its row."""
    if heading.startswith("against "):
        if found := re.match(MEAN, cell):
            row.differences.append((words(heading.removeprefix("against ")), found[0]))
    elif "±" in cell:
        row.means.append(cell)
        row.numbers.append(cell.split()[0])
    elif re.fullmatch(rf"{DECIMAL}|\d+%", cell):
        row.numbers.append(cell.removesuffix("%"))
