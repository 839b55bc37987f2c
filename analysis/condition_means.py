"""Mean PSNR of a run under each condition that `qnerf probe RUN shots=... noise=...` measured."""

import pandas as pd

FILE = "eval_hardware"
CONDITION = ["shots", "noise", "p"]


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
