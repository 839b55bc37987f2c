"""Error and time of each numerical part: `python -m benchmarks.accuracy`.

Compares every case of `benchmarks.accuracy_cases`, in each of its variants and dtypes, with its float64 reference.
Saves benchmarks/results/accuracy.parquet, a row per case, variant and dtype, and writes docs/numerics.md, a row per
part. `--from-saved` writes the page without measuring.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from benchmarks.accuracy_cases import Case, Function, bound_in, modules

RESULTS = Path(__file__).parent / "results" / "accuracy.parquet"
PAGE = Path(__file__).parents[1] / "docs" / "numerics.md"
HEAD = """\
# Numerics

How far each part is from float64, on ordinary and on hard inputs. `python -m benchmarks.accuracy` writes this page and
`benchmarks/results/accuracy.parquet`, which has every case. The same cases and bounds are tests
(`python -m pytest tests/numerics`), in which hypothesis also searches for worse inputs.

- **error**: the largest difference from the float64 reference over all cases of a part, relative to the largest value.
- **gradient**: the same for the gradients of the output's dot product with fixed random numbers.
- **bound**: what the error must not exceed in float32 on the CPU. In float64 the bound is 2^-29 times that, but at
  least 1e-13, because the reference rounds as well.
- **plain**: the error of the plain PyTorch form, where a compiled loop exists. This form runs on CUDA. It has no bound.
- **faster**: the median, over the cases, of the plain form's time divided by the loop's; one thread, forward and
  backward.

`numerics.precision=mixed`, in bfloat16, is not measured here. Derivatives of second and higher order, forward-mode
derivatives and `torch.func` go through the plain form; tests compare them with finite differences
(`tests/model/test_derivatives.py`).

The gradient of a normalisation has a wide bound: with a batch of two it divides by their difference, which enlarges
roundings.
"""


def relative(result: Tensor, exact: Tensor) -> float:
    """Largest difference, relative to the largest value of `exact` or the smallest normal float32 if that is larger.

    Infinity if NaN or infinite values are not the same in both.

    >>> relative(torch.tensor([1.0, 4.5]), torch.tensor([1.0, 4.0]))
    0.125
    """
    result, exact = result.detach().double(), exact.detach().double()
    finite = torch.isfinite(exact)
    same_elsewhere = torch.isclose(result, exact, equal_nan=True)[~finite].all()
    if not torch.equal(finite, torch.isfinite(result)) or not bool(same_elsewhere):
        return math.inf
    if not bool(finite.any()):
        return 0.0
    scale = max(float(exact[finite].abs().max()), torch.finfo(torch.float32).tiny)
    return float((result[finite] - exact[finite]).abs().max()) / scale


def results(case: Case, function: Function, dtype: torch.dtype) -> list[Tensor]:
    """The output, then the gradients of its dot product with fixed random numbers in [-1, 1)."""
    inputs = [t.to(dtype) if t.is_floating_point() else t for t in case.inputs]
    inputs = [t.clone().requires_grad_(i in case.leaves) for i, t in enumerate(inputs)]
    out = function(*inputs)
    if not case.leaves:
        return [out]
    generator = torch.Generator().manual_seed(3)
    upstream = torch.rand(out.shape, generator=generator, dtype=torch.float32).mul(2).sub(1)
    return [out.detach(), *torch.autograd.grad(out, [inputs[i] for i in case.leaves], upstream.to(out.dtype))]


def exact(case: Case) -> list[Tensor]:
    """The `results` of the reference in float64."""
    return results(case, case.reference, torch.float64)


def errors(case: Case, variant: str, dtype: torch.dtype, expected: Sequence[Tensor]) -> tuple[float, float]:
    """`relative` error of the output, and the largest one of a gradient (NaN without gradients)."""
    computed = results(case, case.variants[variant], dtype)
    assert computed[0].dtype == dtype, f"{case.id}: {variant} of {dtype} gave {computed[0].dtype}"
    forward, *gradients = (relative(a, b) for a, b in zip(computed, expected, strict=True))
    return forward, max(gradients, default=math.nan)


def milliseconds(step: Callable[[], object], repeats: int) -> float:
    """Median time of a call, after one warm-up call."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        step()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times[1:])


def measure(case: Case, repeats: int) -> list[dict[str, Any]]:
    """Errors, bounds and time of a case: a row per variant and dtype."""
    expected = exact(case)
    rows = []
    for dtype in case.dtypes:
        for variant, function in case.variants.items():
            forward, gradient = errors(case, variant, dtype, expected)
            rows.append(
                {
                    "part": case.part,
                    "case": case.name,
                    "variant": variant,
                    "dtype": str(dtype).removeprefix("torch."),
                    "values": expected[0].numel(),
                    "error": forward,
                    "ulp": forward / torch.finfo(dtype).eps,
                    "gradient_error": gradient,
                    "bounded": variant in case.bounded,
                    "bound": bound_in(dtype, case.bound),
                    "gradient_bound": math.nan if case.gradient is None else bound_in(dtype, case.gradient),
                    "ms": milliseconds(partial(results, case, function, dtype), repeats),
                    "repeats": repeats,
                    "threads": torch.get_num_threads(),
                }
            )
    return rows


def beyond(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows whose error exceeds its bound."""
    over = (frame["error"] > frame["bound"]) | (frame["gradient_error"] > frame["gradient_bound"])
    return frame[frame["bounded"] & over]


def page(frame: pd.DataFrame, groups: Sequence[str]) -> str:
    """The page in Markdown: a row per part, then the limits that each module of cases states.

    Args:
        frame: the rows of `measure`.
        groups: docstrings of the modules of cases. What follows the first line is a paragraph of the page.
    """
    single = frame[frame["dtype"] == "float32"]
    lines = ["| part | error | bound | gradient | bound | plain | faster |", "|---|---|---|---|---|---|---|"]
    for part, rows in single.groupby("part", sort=False):
        own, plain = rows[rows["bounded"]], rows[~rows["bounded"]]
        largest = own[["error", "bound", "gradient_error", "gradient_bound"]].max()
        times = plain.set_index("case")["ms"] / own.groupby("case")["ms"].min()
        faster = f"{times.median():.1f}" if len(plain) else ""
        cells = [*map(number, largest), number(plain["error"].max()), faster]
        lines.append(f"| {part} | {' | '.join(cells)} |")
    limits = [rest for text in groups if (rest := cleandoc(text).partition("\n")[2].strip())]
    return "\n\n".join([HEAD.strip(), "\n".join(lines), "## Limits", *limits]) + "\n"


def number(value: float) -> str:
    """`1.2e-07`; empty for NaN."""
    return "" if math.isnan(value) else f"{value:.1e}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from-saved", action="store_true", help="use the saved results instead of measuring")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    groups = modules().values()
    if not options.from_saved:
        torch.set_num_threads(options.threads)
        rows = [row for module in groups for case in module.cases() for row in measure(case, options.repeats)]
        pd.DataFrame(rows).to_parquet(RESULTS, index=False)
    frame = pd.read_parquet(RESULTS)
    PAGE.write_text(page(frame, [module.__doc__ or "" for module in groups]))
    if len(beyond(frame)):
        raise SystemExit(f"errors beyond their bounds:\n{beyond(frame).to_string()}")


if __name__ == "__main__":
    main()
