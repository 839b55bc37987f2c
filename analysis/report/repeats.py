"""Settings that do not act, and runs that therefore did the same twice.

A sweep over the circuits of both heads trains each classical field once a circuit. Such runs have equal
`points.effective` settings; with the same seed, too, they must not count as two seeds.
"""

import pandas as pd

from analysis.figures import points
from analysis.selection import configuration


def first_of_each(frame: pd.DataFrame) -> pd.Series:
    """`run_id` of the first finished run of the same scene, settings and seed, for runs that repeat it, else None."""
    finished = frame[frame["state"] == "finished"]
    if finished.empty:
        return pd.Series(None, index=frame.index, dtype=object)
    keys = pd.concat([finished[["scene_name", "seed"]], points.effective(finished)], axis=1)
    firsts = finished["run_id"].groupby([keys[name] for name in keys], dropna=False).transform("first")
    return firsts.where(firsts != finished["run_id"]).reindex(frame.index).astype(object)


def acting(frame: pd.DataFrame) -> pd.DataFrame:
    """The runs that repeat none, without the settings that do not act in them: None there."""
    table = frame[frame["repeats"].isna()].copy()
    settings = points.effective(table)
    table = table.drop(columns=[name for name in configuration(table) if name not in settings])
    for name in settings:
        idle = settings[name] == ""
        if idle.any():
            table[name] = table[name].astype(object).mask(idle, None)
    table["qiren"] = ""
    table["hash"] = table["hash"].where(table["encoder"] == "hash")
    return table
