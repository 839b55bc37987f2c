"""The results of `benchmarks.accuracy` as a page of tables."""

import inspect
import math
from collections.abc import Mapping

import pandas as pd

HEAD = """\
# Numerics

How far each part is from float64, on ordinary and on hard inputs. `python -m benchmarks.accuracy --write
docs/numerics.md` writes this page from `benchmarks/results/accuracy.parquet`. The same cases and bounds are tests
(`python -m pytest tests/numerics`), in which hypothesis also searches for worse inputs; `QNERF_HYPOTHESIS=long` tries
10^5 of them.

- **error**: the largest difference from the float64 reference over all values, relative to the largest value. One ulp
  is 2^-23 of the largest value. All inputs are exact in float32, so no error comes from rounding them.
- **gradient**: the same for the gradients of the output's dot product with fixed random numbers.
- **bound**: what the error must not exceed in float32 on the CPU. In float64 the bound is 2^-29 times that, but at
  least 1e-13, because the reference rounds as well.
- **variant**: `fast` is the compiled loop. `plain` is the PyTorch form that it is tested against and that runs on CUDA;
  it has no bound if there is a `fast` one. No part runs in bfloat16.
- **ms**: median of {repeats} forward and backward passes with {threads} thread{s}, all measured in one process.

Derivatives of second and higher order (`create_graph=True`), forward-mode derivatives and `torch.func` (`grad`, `vmap`,
`jvp`, `hessian`, ...) go through the plain form, whole models included; tests compare them with finite differences
(`tests/model/test_derivatives.py`). So do the batched gradients of `vectorize=True` in `torch.autograd.functional`.
"""


WORST = """\
Of the variants that have a bound. What runs on CUDA is `plain` below, in places a few times less exact. The gradient
of a normalisation has a wide bound: with a batch of two it divides by their difference, which enlarges roundings.
"""


def page(frame: pd.DataFrame, groups: Mapping[str, str]) -> str:
    """The page in Markdown: the largest errors of each part, then a section per group of cases.

    Args:
        frame: the rows that `benchmarks.accuracy` saves.
        groups: name of a group of cases -> its docstring, whose first line is the section's title.
    """
    first = frame.iloc[0]
    head = HEAD.format(repeats=first["repeats"], threads=first["threads"], s="" if first["threads"] == 1 else "s")
    parts = [head, "## Largest errors of each part, float32\n", WORST, worst(frame)]
    for name, text in groups.items():
        own = frame[frame["group"] == name]
        title, _, rest = inspect.cleandoc(text).partition("\n")
        parts += [f"## {title.rstrip('.')}\n", *([rest.strip() + "\n"] if rest.strip() else [])]
        parts += [f"### {part}\n\n{table(rows)}" for part, rows in own.groupby("part", sort=False)]
    return "\n".join(parts)


def worst(frame: pd.DataFrame) -> str:
    """A row per part: the largest errors of the variants that have a bound."""
    bounded = frame[frame["bounded"] & (frame["dtype"] == "float32")]
    columns = ["error", "bound", "gradient_error", "gradient_bound"]
    largest = bounded.groupby("part", sort=False)[columns].max()
    lines = [[part, *map(number, row)] for part, row in zip(largest.index, largest.to_numpy(), strict=True)]
    return markdown(1, ["part", "error", "largest bound", "gradient", "largest bound "], lines)


def table(rows: pd.DataFrame) -> str:
    """A row per case and variant: the results in float32, then those in float64."""
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
    """`1.2e-07`; empty for NaN."""
    return "" if math.isnan(value) else "0" if value == 0 else f"{value:.1e}"


def markdown(text_columns: int, columns: list[str], lines: list[list[str]]) -> str:
    """A table whose first columns are text, aligned left, and the others numbers, aligned right."""
    rows = [columns, ["---"] * text_columns + ["---:"] * (len(columns) - text_columns), *lines]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)
