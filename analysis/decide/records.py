"""What was decided in a store, read without anything that trains."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.records.files import read_json

FOLDER = ".decisions"
"""In a store: a record a question."""


def records(store: str | Path) -> pd.DataFrame:
    """The records of a store: what ended or was compared last in each scene, and the question that it belongs to."""
    tables = []
    for path in sorted(Path(store).glob(f"{FOLDER}/*.json")):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # a damaged record is left out
            found = read_json(path)
            looks = pd.DataFrame(found["looks"])
            last = looks[looks["ended"] | (looks["seeds"] == looks.groupby("scene")["seeds"].transform("max"))]
            asked = {key: found["question"][key] for key in ("within", "metric", "equal", "common")}
            steps = ", ".join(f"{name} {count}" for name, count in found["steps"].items())
            changes = "; ".join(f"budget {change['budget']:g} s at {change['time']}" for change in found["changes"])
            study = {
                "registered": found["registered"]["time"],
                "changes": changes,
                "searched": searched(found["tuned"]),
            }
            tables.append(last.assign(**asked, most=found["most"], steps=steps, **study))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def searched(tuned: Mapping[str, Mapping[str, Any]]) -> str:
    """What a search chose for each candidate, after how many trials, and what it cost."""
    texts = [
        f"{name}: {', '.join(one['chosen'])} ({one['trials']} trials, {one['seconds'] / 60:.0f} minutes, expected best "
        f"{one['expected'][0]:.4g} of 1, {one['expected'][-1]:.4g} of {len(one['expected'])})"
        for name, one in tuned.items()
    ]
    return "; ".join(texts)
