"""What was decided in a store, read without anything that trains."""

import contextlib
from pathlib import Path

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
            tables.append(last.assign(**asked, most=found["most"], steps=steps))
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()
