"""A question to decide: its candidates, the runs that belong to them, and its record in the store."""

import hashlib
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd

from qnerf.cli.identify import run_ids
from qnerf.records.files import read_json, replace
from qnerf.search.objectives import TUNING

from ..load import runs
from .commands import child, ended, run_of, seconds, train
from .looks import looks
from .records import FOLDER, is_command, name_of, title

notes: set[str] = set()
"""What trainings of this process have told already."""


@dataclass(frozen=True)
class Question:
    """What is compared: the first candidate is the baseline. Each text holds overrides, or a command of the user's own.

    scenes: overrides that choose a scene, one text a scene. equal: "steps", or "time" for equal CPU seconds. tune:
    trials of a search for each candidate before; 0: none. space: options with other values than those of the heads.
    """

    candidates: tuple[str, ...]
    scenes: tuple[str, ...]
    common: str
    within: float
    metric: str = "psnr"
    equal: str = "steps"
    tune: int = 0
    space: tuple[str, ...] = ()

    @property
    def commands(self) -> bool:
        """Whether candidates are programs of the user's own."""
        return any(is_command(text.split()) for text in self.candidates)

    @property
    def comparisons(self) -> int:
        """How many verdicts the study may give; a race may compare any two candidates."""
        return len(self.scenes) * len(self.candidates) * (len(self.candidates) - 1) // 2

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Each scene with each candidate."""
        return [(scene, candidate) for scene in self.scenes for candidate in self.candidates]


@dataclass
class Record:
    """What has been found so far. It stays in the store, so that a question is not asked again until it pleases.

    name: of the file; another question, or the same about other runs, has another. runs: "scene: candidate" -> the ids
    of its runs. most: seeds a side at the last look, fixed after the first. steps: "scene: candidate" -> training steps
    where CPU time is to be equal. looks: what each look at each comparison found, in order; `ended`: that was its last.
    spaces: "scene: candidate" -> option -> the values that its search may choose. tuned: "scene: candidate" -> what was
    tried, what was chosen and what it cost. registered: when the record was written, before the first run, the budget
    in seconds, the numbers of seeds at which it may look, and the seeds of the search; changes: later budgets.
    earlier: "scene: candidate" -> how many of its runs were begun before, by another study or a sweep.
    """

    question: Question
    name: str
    runs: dict[str, list[str]] = field(default_factory=dict)
    most: int = 0
    steps: dict[str, int] = field(default_factory=dict)
    looks: list[dict[str, Any]] = field(default_factory=list)
    spaces: dict[str, dict[str, str]] = field(default_factory=dict)
    tuned: dict[str, dict[str, Any]] = field(default_factory=dict)
    earlier: dict[str, int] = field(default_factory=dict)
    registered: dict[str, Any] = field(default_factory=dict)
    changes: list[dict[str, Any]] = field(default_factory=list)

    def words(self, scene: str, candidate: str) -> list[str]:
        """Of a command, or the overrides of a run; `steps` come last, so that they hold."""
        if is_command(candidate.split()):
            return shlex.split(f"{candidate} {self.question.common} {scene}")
        steps = self.steps.get(title(scene, candidate))
        last = [f"train.steps={steps}"] if steps else []
        chosen = self.tuned.get(title(scene, candidate), {}).get("chosen", [])
        return [*scene.split(), *self.question.common.split(), *candidate.split(), *chosen, *last]

    def register(self, budget: float, store: Path) -> None:
        """Writes the record before anything is trained; a later command with another budget is a change."""
        now = {"time": datetime.now(UTC).isoformat(timespec="seconds"), "budget": budget}
        self.join(store)
        if not self.registered:
            self.registered = now | {"looks": looks(), "tuning_seeds": TUNING if self.question.tune else []}
        elif budget != (self.changes or [self.registered])[-1]["budget"]:
            self.changes.append(now)
        self.save(store)

    def open(self, scene: str) -> list[str]:
        """The candidates still in question; one alone: the scene is decided."""
        ended = {look["candidate"] for look in self.looks if look["ended"] and look["scene"] == name_of(scene)}
        return [name for name in self.question.candidates if name not in ended]

    def join(self, store: Path) -> None:
        """Takes over what another process of the same study has registered, found or fixed since."""
        path = store / FOLDER / f"{self.name}.json"
        if path.exists():
            known = read_json(path)
            self.registered, self.most = known["registered"], known["most"] or self.most
            self.changes, self.looks = (max(known[key], getattr(self, key), key=len) for key in ("changes", "looks"))
            self.tuned = known["tuned"] | self.tuned

    def save(self, store: Path) -> None:
        self.join(store)
        path = store / FOLDER / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        replace(path, json.dumps(asdict(self), indent=1).encode())

    @classmethod
    def of(cls, question: Question, store: Path) -> "Record":
        """The stored record of this question about these runs, or a new one.

        ValueError where it is damaged, a configuration or a scene is not valid, or two candidates are the same.
        """
        new, first = cls(question, ""), dict[str, str]()  # "scene: candidate" -> what tells it from others
        for scene, candidate in question.pairs:
            name, words = title(scene, candidate), new.words(scene, candidate)
            digest = shlex.join(words) if is_command(words) else run_ids(words, [0], store)[0].rpartition("-")[2]
            if same := next((other for other, known in first.items() if known == digest), None):
                raise ValueError(f"{name}: the same configuration as {same}; leave one out")
            first[name] = digest
        text = json.dumps([asdict(question), first], sort_keys=True)
        new.name = hashlib.sha256(text.encode()).hexdigest()[:12]
        path = store / FOLDER / f"{new.name}.json"
        try:
            return cls(**(read_json(path) | {"question": question})) if path.exists() else new
        except TypeError:
            raise ValueError(f"{path}: no record as this version writes it; move it away to begin anew") from None


def trained(
    words: Sequence[str], seeds: Sequence[int], store: Path, foresee: Callable[[float], object]
) -> pd.DataFrame:
    """`found` after the runs that are not finished were trained, by any launcher; a run that diverged has no metric.

    foresee: gets the seconds that a run is going to take, or took. What it raises, and what stops this process, stops
    the trainings, too.
    ValueError where a run failed for another reason, KeyboardInterrupt where it was stopped.
    """
    if is_command(words):
        train(words, seeds, store, foresee)
    else:
        started([*words, f"store={store}", f"seed={','.join(map(str, seeds))}"], foresee)
    frame = found(words, seeds, store)
    diverged = frame["error"].astype(str).str.contains("diverged|not finite")
    for name in frame.index[frame["state"].ne("finished") & ~diverged]:
        raise ValueError(f"{name}: {frame.loc[name, 'state']}; `qnerf show {name}` says why")
    return frame


def started(arguments: Sequence[str], foresee: Callable[[float], object]) -> None:
    """Trains what `qnerf run -m` with these arguments trains; `foresee` and errors as `trained` has them, but for runs
    that failed. Of what the trainings print, the run's folder and how long it takes stay; with Slurm, where its output
    is; and notes, once each."""
    command = [sys.executable, "-m", "qnerf", "run", "-m", *arguments]
    with child(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout or ():
            if (
                re.match(r"(\d+ \| )?((.*: )?run |.*a step takes about )|jobs go to |note: ", line)
                and line not in notes
            ):
                print(line, end="", flush=True)
            if line.startswith("note: "):
                notes.add(line)
            if told := re.search(r"a step takes about .* the whole ([\d,.]+) hours", line):
                foresee(3600 * float(told[1].replace(",", "")))
    if process.returncode not in (0, 1):  # 1: a job failed
        raise ended(process.returncode, " ".join(command[3:]))


def found(words: Sequence[str], seeds: Sequence[int], store: Path) -> pd.DataFrame:
    """The rows of these runs, as `load.runs` has them, in the order of the seeds; a missing run's are empty.

    `train_s` of a command is what its process took."""
    own = [run_of(words, seed, store).name for seed in seeds] if is_command(words) else run_ids(words, seeds, store)
    frame = runs(store).set_index("run_id").reindex(own)
    if is_command(words):
        frame["train_s"] = [seconds(words, seed, store) for seed in seeds]
    return frame.assign(error=frame.get("error"))
