"""A question to decide: its candidates, the runs that belong to them, and its record in the store."""

import contextlib
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.cli.identify import run_ids
from qnerf.records.files import read_json, replace

from ..load import runs

FOLDER = ".decisions"
"""In a store: a record a question."""


@dataclass(frozen=True)
class Question:
    """What is compared: the first candidate is the baseline. Each text holds overrides, as on the command line.

    scenes: overrides that choose a scene, one text a scene. equal: "steps", or "time" for equal CPU seconds.
    """

    candidates: tuple[str, ...]
    scenes: tuple[str, ...]
    common: str
    within: float
    metric: str = "psnr"
    equal: str = "steps"

    @property
    def name(self) -> str:
        """The name of its record: the same question has the same record."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:12]

    def overrides(self, scene: str, candidate: str, steps: int | None = None) -> list[str]:
        return [*scene.split(), *self.common.split(), *candidate.split(), *([f"train.steps={steps}"] if steps else [])]


@dataclass
class Record:
    """What has been decided so far. It stays in the store, so that a question is not asked again until it pleases.

    most: seeds a side at the last look, fixed after the first. steps: scene and candidate -> training steps of the
    cheaper side where CPU time is to be equal. looks: what each look found, in order.
    """

    question: Question
    most: int = 0
    cost_s: float = 0.0
    steps: dict[str, int] = field(default_factory=dict)
    looks: list[dict[str, Any]] = field(default_factory=list)
    verdicts: dict[str, str] = field(default_factory=dict)

    def save(self, store: Path) -> None:
        path = store / FOLDER / f"{self.question.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        replace(path, json.dumps(asdict(self), indent=1).encode())

    @classmethod
    def of(cls, question: Question, store: Path) -> "Record":
        """The stored record, or a new one. ValueError where it is damaged."""
        path = store / FOLDER / f"{question.name}.json"
        return cls(**(read_json(path) | {"question": question})) if path.exists() else cls(question)


def records(store: str | Path) -> pd.DataFrame:
    """The records of a store, a row a comparison: what was compared, verdict, looks, seeds, difference."""
    rows: list[dict[str, Any]] = []
    for path in sorted(Path(store).glob(f"{FOLDER}/*.json")):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # a damaged record is left out
            rows += _rows(read_json(path))
    return pd.DataFrame(rows)


def _rows(record: dict[str, Any]) -> list[dict[str, Any]]:
    asked, rows = record["question"], []
    steps = ", ".join(f"{name} {count}" for name, count in record["steps"].items())
    for name in dict.fromkeys([*(look["name"] for look in record["looks"]), *record["verdicts"]]):
        own = [look for look in record["looks"] if look["name"] == name]
        last = own[-1] if own else {}
        numbers = {key: last.get(key) for key in ("seeds", "difference", "reach", "spent")}
        rows.append(
            {"comparison": name, "baseline": asked["candidates"][0],
             "verdict": record["verdicts"].get(name, "not decided yet"), "within": asked["within"],
             "metric": asked["metric"], "equal": asked["equal"], "looks": len(own), "most": record["most"],
             **numbers, "of every run": asked["common"], "steps": steps}
        )  # fmt: skip
    return rows


def train(overrides: Sequence[str], seeds: Sequence[int]) -> None:
    """Trains the seeds that are not finished yet, by any launcher. KeyboardInterrupt if that was stopped.

    Of what the trainings print, a line each stays: the run's folder; with Slurm, where its output is.
    """
    command = [sys.executable, "-m", "qnerf", "run", "-m", *overrides, f"seed={','.join(map(str, seeds))}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout or ():
            if re.match(r"(\d+ \| )?run |jobs go to ", line):
                print(line, end="", flush=True)
    code = process.returncode
    if code in (130, -2):
        raise KeyboardInterrupt
    if code not in (0, 1):  # 1: a job failed, which `results` says
        raise ValueError(f"training ended with exit code {code}: {' '.join(command[3:])}")


def results(store: Path, overrides: Sequence[str], seeds: Sequence[int]) -> pd.DataFrame:
    """The rows of these runs, as `load.runs` has them, in the order of the seeds; a run that diverged has no metric.

    ValueError where a run is missing, or failed for another reason.
    """
    names = run_ids(overrides, seeds, store)
    frame = runs(store).set_index("run_id").reindex(names)
    diverged = frame["error"].astype(str).str.contains("diverged|not finite") if "error" in frame else False
    if (missing := frame["state"].ne("finished") & ~diverged).any():
        name = frame.index[missing][0]
        raise ValueError(f"{name}: {frame.loc[name, 'state']}; `qnerf show {name}` says why")
    return frame


def known(store: Path, overrides: Sequence[str], most: int) -> int:
    """How many of the seeds 0, 1, ... are finished in the store already."""
    try:
        states = runs(store).set_index("run_id")["state"]
    except ValueError:
        return 0
    names = run_ids(overrides, range(most), store)
    done = [states.get(name) == "finished" for name in names]
    return done.index(False) if False in done else len(done)
