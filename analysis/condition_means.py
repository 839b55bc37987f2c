"""What `qnerf evaluate RUN shots=... noise=...` measured of a run, one number a condition."""

import pandas as pd

FILE = "eval_hardware"
CONDITION = ["shots", "noise", "p"]


def means(rows: pd.DataFrame) -> pd.DataFrame:
    """Mean PSNR (dB) of each condition of one run over views and random seeds: columns shots (0: exact), noise
    ("none"), p, psnr. Only views that the run has under each of its conditions count.
    """
    several = len(rows[CONDITION].drop_duplicates())
    seen = rows.drop_duplicates(["image", *CONDITION]).groupby("image").size()
    kept = rows[rows["image"].isin(seen[seen == several].index)]
    return kept.groupby(CONDITION, as_index=False)["psnr"].mean()


def condition_name(shots: int, noise: str, p: float) -> str:
    """`exact`, `100 shots`, `depolarizing 0.01` or both of the latter."""
    parts = [f"{noise} {p:g}" if noise != "none" else "", f"{shots:,} shots" if shots else ""]
    return ", ".join(filter(None, parts)) or "exact"
