"""What a table can show of a run: heading, format, and which way is better."""

from dataclasses import dataclass
from typing import Literal

import pandas as pd


@dataclass(frozen=True)
class Value:
    heading: str
    form: str
    better: Literal["max", "min"] | None = None


VALUES = {
    "psnr": Value("PSNR, dB", "{:.2f}", "max"),
    "ssim": Value("SSIM", "{:.3f}", "max"),
    "lpips": Value("LPIPS", "{:.4f}", "min"),
    "depth_error": Value("depth error", "{:.3f}", "min"),
    "depth_error_median": Value("median depth error", "{:.3f}", "min"),
    "params.encoder": Value("encoder parameters", "{:,.0f}"),
    "params.density": Value("density parameters", "{:,.0f}"),
    "params.color": Value("colour parameters", "{:,.0f}"),
    "params.sampler": Value("proposal parameters", "{:,.0f}"),
    "params.cameras": Value("camera parameters", "{:,.0f}"),
    "params.appearance": Value("appearance parameters", "{:,.0f}"),
    "params.total": Value("parameters", "{:,.0f}"),
    "step_ms": Value("ms a step", "{:.1f}", "min"),
    "train_s": Value("training, s", "{:.0f}", "min"),
}
"""Column of a run -> how it is shown. Any other numeric column is shown under its own name."""


def value(name: str) -> Value:
    return VALUES.get(name, Value(name, "{:.4g}"))


def shown(name: str, mean: float, std: float, n: int, seeds: int) -> str:
    """`26.00 ± 0.48`; one seed has no spread, and `(n = 2)` says that only 2 of the row's seeds have the value."""
    if pd.isna(mean):
        return ""
    form = value(name).form
    spread = "" if name.startswith("params.") or pd.isna(std) else f" ± {form.format(std)}"
    return form.format(mean) + spread + (f" (n = {n})" if n < seeds else "")
