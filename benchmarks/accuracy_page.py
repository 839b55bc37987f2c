"""The figures of `benchmarks.accuracy` as a page of tables."""

import inspect
import math
from collections.abc import Mapping

import pandas as pd

HEAD = """\
# Numerics

How far each part is from float64, on ordinary and on hard inputs. Written by
`python -m benchmarks.accuracy --write docs/numerics.md` from `benchmarks/results/accuracy.parquet`; the same cases and
bounds are tests (`python -m pytest tests/numerics`), where hypothesis also searches for worse inputs:
`QNERF_HYPOTHESIS=long` for 10^5 of them.

An error is the largest difference from the float64 reference over all values, relative to the largest value; one ulp is
2^-23 of that. Inputs are numbers that float32 holds, so that no error is that of the inputs. Gradients are those of the
output's product with fixed random numbers. Bounds hold for float32 on the CPU; in float64 2^-29 times them, but at
least 1e-13, where the reference rounds as well. `fast` is the compiled loop, `plain` the PyTorch form that it is
tested against and that CUDA takes, without a bound where there is a fast one. No part is offered in bfloat16. Times are
medians of {repeats} of a forward and backward pass with {threads} thread{s}, all in one run.
"""


def page(frame: pd.DataFrame, groups: Mapping[str, str]) -> str:
    """Markdown: the worst of each part, then a table a group under its docstring.

    Args:
        frame: what `benchmarks.accuracy` saves.
        groups: name of a group of cases -> its title and what has to be said about it.
    """
    first = frame.iloc[0]
    head = HEAD.format(repeats=first["repeats"], threads=first["threads"], s="" if first["threads"] == 1 else "s")
    parts = [head, "## Worst of each part, float32\n", worst(frame)]
    for name, text in groups.items():
        own = frame[frame["group"] == name]
        title, _, rest = inspect.cleandoc(text).partition("\n")
        parts += [f"## {title.rstrip('.')}\n", *([rest.strip() + "\n"] if rest.strip() else [])]
        parts += [f"### {part}\n\n{table(rows)}" for part, rows in own.groupby("part", sort=False)]
    return "\n".join(parts)


def worst(frame: pd.DataFrame) -> str:
    """One row a part: the largest errors of what the bounds hold for."""
    bounded = frame[frame["bounded"] & (frame["dtype"] == "float32")]
    columns = ["error", "bound", "gradient_error", "gradient_bound"]
    largest = bounded.groupby("part", sort=False)[columns].max()
    lines = [[part, *map(number, row)] for part, row in zip(largest.index, largest.to_numpy(), strict=True)]
    return markdown(1, ["part", "error", "largest bound", "gradient", "largest bound "], lines)


def table(rows: pd.DataFrame) -> str:
    """One row a case and variant: the float32 figures, then the float64 ones."""
    keys = ["case", "variant"]
    single = rows[rows["dtype"] == "float32"].set_index(keys)
    double = rows[rows["dtype"] == "float64"].set_index(keys)
    bounds = single[["bound", "gradient_bound"]].where(single["bounded"])
    columns = {
        "error": single["error"].map(number),
        "ulp": single["ulp"].map("{:.2g}".format),
        "bound": bounds["bound"].map(number),
        "gradient": single["gradient_error"].map(number),
        "bound ": bounds["gradient_bound"].map(number),
        "float64": double[["error", "gradient_error"]].max(axis=1).map(number),
        "ms": single["ms"].map("{:.2f}".format),
        "ms float64": double["ms"].map("{:.2f}".format),
    }
    shown = pd.DataFrame(columns, index=rows.set_index(keys).index.unique()).fillna("").reset_index()
    return markdown(2, list(shown.columns), shown.to_numpy().tolist())


def number(value: float) -> str:
    """`1.2e-07`; nothing for NaN."""
    return "" if math.isnan(value) else "0" if value == 0 else f"{value:.1e}"


def markdown(words: int, columns: list[str], lines: list[list[str]]) -> str:
    """A table whose first `words` columns are text and the others numbers."""
    rows = [columns, ["---"] * words + ["---:"] * (len(columns) - words), *lines]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
