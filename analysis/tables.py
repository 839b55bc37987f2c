"""Tables over seeds: `python -m analysis.tables runs --rows scene_name,field,color`."""

import argparse
import sys
from collections.abc import Sequence

import pandas as pd

from analysis.load import runs

VALUES = {
    "psnr": ("PSNR, dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "depth_error": ("depth error", "{:.3f}"),
    "params.density": ("density parameters", "{:,.0f}"),
    "params.color": ("colour parameters", "{:,.0f}"),
    "step_ms": ("ms a step", "{:.1f}"),
    "train_s": ("training, s", "{:.0f}"),
}
"""Column -> heading and format."""


def over_seeds(frame: pd.DataFrame, rows: Sequence[str]) -> pd.DataFrame:
    """Mean and standard deviation (n - 1) of `VALUES` over the seeds of each group of finished runs.

    Columns (value, "mean" | "std"), and ("seeds", "n"): a group of one seed has no standard deviation. ValueError where
    a row key does not exist, nothing is finished, or a group has a seed twice and so mixes configurations.
    """
    unknown = [key for key in rows if key not in frame.columns]
    if unknown:
        raise ValueError(f"unknown row key {unknown[0]!r}; known: {', '.join(sorted(frame.columns))}")
    finished = frame[frame["state"] == "finished"]
    if finished.empty:
        raise ValueError(f"no finished runs among {len(frame)}: {frame['state'].value_counts().to_dict()}")
    groups = finished.groupby(list(rows), dropna=False, sort=False)
    twice = groups["seed"].apply(lambda seeds: seeds.duplicated().any())
    if twice.any():
        raise ValueError(
            f"{twice[twice].index[0]} holds a seed twice: add the key that tells those runs apart to the rows"
        )
    values = [name for name in VALUES if finished[name].notna().any()]
    table = groups[values].agg(["mean", "std"])
    table[("seeds", "n")] = groups.size()
    return table.sort_index()


def markdown(table: pd.DataFrame) -> str:
    """A Markdown table of "mean ± std", one row a group."""
    names = [name for name in VALUES if name in table.columns.get_level_values(0)]
    head = [*map(str, table.index.names), *(VALUES[name][0] for name in names), "seeds"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for key, row in table.iterrows():
        cells = [str(part) for part in (key if isinstance(key, tuple) else (key,))]
        for name in names:
            mean, std = row[(name, "mean")], row[(name, "std")]
            form = VALUES[name][1]
            constant = name.startswith("params.") or pd.isna(std)
            cells.append("" if pd.isna(mean) else form.format(mean) + ("" if constant else f" ± {form.format(std)}"))
        lines.append("| " + " | ".join([*cells, f"{row[('seeds', 'n')]:.0f}"]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m analysis.tables", description=__doc__)
    parser.add_argument("store", help="folder of runs")
    parser.add_argument("--rows", default="scene_name,field,color", help="keys that tell the rows apart, with commas")
    options = parser.parse_args()
    try:
        frame = runs(options.store)
        print(markdown(over_seeds(frame, options.rows.split(","))))
    except ValueError as error:
        sys.exit(f"error: {error}")
    left = frame[frame["state"] != "finished"]
    if len(left):
        print(f"\nleft out: {left['state'].value_counts().to_dict()}", file=sys.stderr)


if __name__ == "__main__":
    main()
