"""Checks that a number in a document is in the row that it is quoted from.

The writer names the rows in an HTML comment after the numbers:

    ... by 0.28 ± 0.17 dB. <!-- results rates: fox_64 0.33 - 1 -->

`rates` is the page docs/results/rates/README.md. The words pick cells of its tables: a scene and the keys of a row.
` - ` and the words of another row ask for the difference of the two, whatever its sign. Several rows are separated by
`;`: each number has to be in one of them, and each of them has to have a number. `fox_64/poster 0.33 - 1` stands for a
row of each scene. A comment covers the numbers since the comment before it, or since the start of its paragraph, list
item or table row.

`<!-- each row, results recipe: fox_64 {2} - quick_recipe -->` above a table covers every row without a comment of its
own; {2} stands for the second cell of the row.

Other sources: `<!-- from FILE.parquet: qcolor & threads 2 -->` picks the row of a parquet file whose text has these
parts. `<!-- measured at COMMIT -->` and `<!-- quoted from SOURCE -->` are for numbers that no file holds.
`<!-- checked by TEST -->` names a test in tests/test_documents.py.
"""

import re
from functools import cache

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
COMMENT = re.compile(r"<!--\s+(results|from|measured at|quoted from|checked by) (.*?) ?-->", re.DOTALL)
EACH_ROW = re.compile(r"<!--\s+each row, (results|from|measured at|quoted from|checked by) (.*?) ?-->\n", re.DOTALL)
FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


def problems(text, pages, root=ROOT):
    """One line for each number of a Markdown document that is not where it says, or that has no source."""
    lines = []
    for block, template in blocks(FENCE.sub("", text)):
        for span, kind, source in spans(block, template):
            place, _, names = source.partition(": ")
            if kind == "":
                lines += [f"{number!r}: no source" for number in MUST.findall(plain(span))]
            elif kind == "results":
                lines += unsourced(quoted(span, PERCENT), names, lambda one, page=place: on_page(pages, page, one))
            elif kind == "from":
                lines += unsourced(quoted(span, MEASURED), names, lambda one, file=place: in_file(root / file, one))
    return lines


def blocks(text):
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


def spans(block, template):
    """Text, kind of its source, source; of text after the last comment both are empty."""
    if template and not COMMENT.search(block):
        cells = [re.sub(r"[`*]", "", cell).strip() for cell in block.strip().strip("|").split("|")]
        block += re.sub(r"\{(\d+)\}", lambda match: cells[int(match[1]) - 1], template)
    end = 0
    for match in COMMENT.finditer(block):
        yield block[end : match.start()], match[1], " ".join(match[2].split())
        end = match.end()
    yield block[end:], "", ""


def plain(text):
    """Without code, emphasis and line breaks."""
    return " ".join(re.sub(r"`[^`]*`", "", text).replace("**", "").split())


def quoted(text, more=""):
    return re.findall(QUOTE + more, plain(text))


def unsourced(numbers, names, source_of):
    try:
        sources = {name: source_of(name) for part in names.split(";") for name in of_each_scene(part.strip())}
    except LookupError as error:
        return [str(error.args[0])]
    lost = [number for number in numbers if not any(holds(number) for holds in sources.values())]
    idle = [name for name, holds in sources.items() if not any(map(holds, numbers))]
    return [f"{number!r} is not in {names}" for number in lost] + [f"no number is from {name!r}" for name in idle]


def of_each_scene(name):
    """`fox_64/poster 0.33 - 1` is a row of each of the two scenes."""
    scenes, space, row = name.partition(" ")
    return [name] if "/" not in scenes or not space else [f"{scene} {row}" for scene in scenes.split("/")]


def on_page(pages, page, name):
    """Of `SCENE WORDS [- WORDS]`, the cells of the row, or of the differences of either row from others."""
    first, minus, second = name.casefold().partition(" - ")
    scene = first.split()[0]
    rows = [set(first.split()), {scene, *second.split()}] if minus else [set(first.split())]
    cells = [[text for words, text in pages.get(page, []) if row <= words] for row in rows]
    if not all(cells):
        raise LookupError(f"{name!r} names no row of docs/results/{page}/README.md")
    return lambda number: any(agrees(number, text) for texts in cells for text in texts)


def agrees(number, text):
    """Whether the cell has the number, rounded to the decimals of `number`, with either sign."""
    if "±" in number:
        return number.lstrip("+-") in text
    near = 0.5001 * 10.0 ** -len(number.partition(".")[2])
    return any(abs(abs(float(number)) - float(one)) <= near for one in re.findall(r"\d+\.\d+|\d+(?=%)", text))


def in_file(file, phrases):
    """Whether a number is a value, rounded, of the one row of a parquet file whose text has all phrases."""
    rows = [numbers for text, numbers in parquet_rows(file) if all(phrase in text for phrase in phrases.split(" & "))]
    if len(rows) != 1:
        raise LookupError(f"{phrases!r} names {len(rows)} rows of {file.name}")

    def holds(quote):  # a number, or those of an interval
        parts = re.findall(NUMBER, quote)
        return all(any(round(value, len(n.partition(".")[2])) == float(n) for value in rows[0]) for n in parts)

    return holds


@cache
def parquet_rows(file):
    """Text of a row, without its measured numbers; its measured numbers."""
    frame = pd.read_parquet(file)
    measured = frame.select_dtypes("floating")
    words = frame.drop(columns=measured.columns).to_dict("records")
    texts = [" ".join(f"{key} {value}" for key, value in row.items()) + " " for row in words]
    return list(zip(texts, measured.to_numpy().tolist(), strict=True))


@cache
def results():
    """The measured cells of each page of results."""
    pages = (ROOT / "docs" / "results").glob("*/README.md")
    return {page.parent.name: measured(page.read_text()) for page in pages}


MEASURES = re.compile(r"(?:(.+): )?((?:PSNR|exact|KS|distance error|error in octave|explained|against).*)")
"""The heading of a measured column: `fox_64: PSNR, dB`, `against classical`."""


def measured(page):
    """A cell's words: of its row, up to the first measured column, of the scene in its heading, and of each row."""
    found = []
    each = words_of(" ".join(re.findall(r"^In each row: (.*)\.$", page, re.MULTILINE)))
    for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE):
        header, _, *rows = [[cell.strip() for cell in row.strip()[1:-1].split("|")] for row in table.splitlines()]
        start = next((i for i, name in enumerate(header) if MEASURES.fullmatch(name)), len(header))
        scenes = [match[1] or "" if (match := MEASURES.fullmatch(name)) else "" for name in header]
        for row in rows:
            words = each | words_of(" ".join(row[:start]))
            found += [({*words, scene.casefold()}, text) for scene, text in list(zip(scenes, row, strict=True))[start:]]
    return found


def words_of(text):
    return set(re.sub(r"\*\*|[,;](?= )", "", text).casefold().split())
