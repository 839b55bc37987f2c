"""What reviewers ask of a table of circuits: quality beside time, memory, parameters, gates, device hours and noise."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import pandas as pd

from qnerf.metrics import HEAD_PARAMETERS, quality_metrics

from .. import packed
from ..selection import CIRCUITS, select
from .ablation import ablation
from .table import Table

SHOTS, RATE = 1000, 10_000.0
"""Shots of an evaluation of a circuit, and shots that a device takes in a second."""
HARDWARE = "eval_hardware"
CONDITION = ["shots", "noise", "p"]
GIVEN = (*HEAD_PARAMETERS, "params.total", "train_s", "step_cpu_ms", "peak_memory_mb")


def resources(
    frame: pd.DataFrame,
    rows: Sequence[str],
    *,
    metric: str = "psnr",
    baseline: str | Mapping[str, object] | None = None,
    within: float | None = None,
    rate: float = RATE,
    title: str = "Quality, cost and hardware",
) -> Table:
    """`ablation` of the image metrics, sizes and times, and of what the probes of the runs found.

    `qnerf probe RUN cost` gives gates, depth and device hours at `rate` shots a second; `qnerf probe RUN shots=...
    noise=...` the PSNR under each condition. Runs that were not probed have no value there. Raises ValueError as
    `ablation` does.
    """
    runs = select(frame, metric).runs
    costs, damaged = packed.probe_tables(runs["path"], "cost")
    measured, also_damaged = packed.probe_tables(runs["path"], HARDWARE)
    steps = frame.set_index("path")["train.steps"]
    found = {path: cost_of(table, float(steps[path]), rate) for path, table in costs.items()}
    conditions = _ordered(measured)
    for condition, column in conditions.items():
        for path, table in measured.items():
            own = means(table).set_index(CONDITION)["psnr"]
            if condition in own.index:
                found.setdefault(path, {})[column] = own[condition]
    probed = pd.DataFrame.from_dict(found, orient="index")
    probed = probed[[*(name for name in probed if name.startswith("cost.")), *conditions.values()]]
    quality = [item.key for item in quality_metrics() if not item.on_request]
    values = [name for name in dict.fromkeys((metric, *quality, *GIVEN)) if name in runs and runs[name].notna().any()]
    own = frame.join(probed, on="path")
    made = ablation(own, rows, metric=metric, values=[*values, *probed], baseline=baseline, within=within, title=title)
    return replace(made, notes=(*made.notes, *_notes(frame, rate, len(costs), len(measured), damaged, also_damaged)))


def cost_of(table: pd.DataFrame, steps: float, rate: float = RATE) -> dict[str, float]:
    """Of one run, from the rows of its circuits: gates of all circuits, depth of the deepest, hours of a device.

    A view takes `SHOTS` shots of each evaluation. Training takes them for `steps` steps, with gradients by the
    parameter-shift rule.
    """
    hours = SHOTS / rate / 3600
    return {
        "cost.gates": float(table["one_qubit_gates"].sum() + table["two_qubit_gates"].sum()),
        "cost.two_qubit_gates": float(table["two_qubit_gates"].sum()),
        "cost.depth": float(table["depth"].max()),
        "cost.view_hours": float(table["view"].sum()) * hours,
        "cost.train_hours": float(table["step"].sum()) * steps * hours,
    }


def means(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean PSNR (dB) of one run under each condition, over views and random seeds.

    Columns shots (0: exact), noise ("none"), p, psnr. Only views that were measured under every condition count.
    """
    conditions = len(rows[CONDITION].drop_duplicates())
    measured = rows.drop_duplicates(["image", *CONDITION]).groupby("image").size()
    common = rows[rows["image"].isin(measured[measured == conditions].index)]
    return common.groupby(CONDITION, as_index=False)["psnr"].mean()


def condition_name(shots: int, noise: str, p: float) -> str:
    """`exact`, `100 shots`, `depolarizing 0.01`, `depolarizing 0.01 readout=0.02`, or shots and noise together."""
    channel, *others = noise.split() if noise != "none" else [""]
    parts = [" ".join([channel, *([f"{p:g}"] if p else []), *others]), f"{shots:,} shots" if shots else ""]
    return ", ".join(filter(None, parts)) or "exact"


def _ordered(measured: Mapping[str, pd.DataFrame]) -> dict[tuple[int, str, float], str]:
    """Condition -> its column: shots alone first, then by noise, its p and shots.

    The exact one is the run's PSNR, and has a column where fewer views were measured than the run has.
    """
    every = [row for table in measured.values() for row in table[CONDITION].drop_duplicates().itertuples(index=False)]
    order = sorted({tuple(row) for row in every}, key=lambda row: (row[1] != "none", row[1], row[2], row[0]))
    names = {condition: condition_name(*condition) for condition in order}
    fewer = any(table["image"].nunique() < len(packed.views(path)) for path, table in measured.items())
    titles = names | {condition: "exact, the same views" for condition, name in names.items() if name == "exact"}
    return {condition: f"psnr @ {titles[condition]}" for condition in order if fewer or names[condition] != "exact"}


def _notes(frame: pd.DataFrame, rate: float, costs: int, measured: int, *damaged: str) -> list[str]:
    circuits = int((frame["state"].eq("finished") & frame["field"].isin(CIRCUITS)).sum())
    notes = [f"device hours: {SHOTS:,} shots an evaluation, {rate:,.0f} shots a second"] if costs else []
    for count, probe in ((costs, "cost"), (measured, "shots=100,1000")):
        if count < circuits:
            notes.append(f"{circuits - count} of {circuits} circuit runs were not probed: qnerf probe RUN {probe}")
    return [*notes, *damaged]
