"""`qnerf decide A B`: see `--help`."""

import argparse
import itertools
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from qnerf.cli import compose
from qnerf.metrics import metric_of, quality_metrics
from qnerf.records.location import DEFAULT
from qnerf.search.objectives import TUNING
from qnerf.training.forecast import announced

from .. import command
from ..selection import colorless, measured
from ..tables.differences import interval
from ..verdict import trim, trimmed, verdict, within_of
from .looks import FIRST, MOST, looks, shares
from .records import is_command, name_of, names_of, title
from .study import Question, Record, trained
from .tune import AGAIN, asked_spaces, spaces, tune

DESCRIPTION = """\
Trains seeds of each candidate until it is decided which is better, or that they are equivalent, or until the end of
the budget. A candidate is a text of overrides, as of `qnerf run`, or a command of your own, which finds a seed in
QNERF_SEED and tracks a run with it (docs/analysis.md); the first is the baseline. Several are raced: each is compared
with the one that leads, and what is decided trains no more. Finished runs of the store count, and the same command goes
on with what was stopped. No more than 5 % of such studies end with a wrong verdict, over all looks, candidates and
scenes. The record stays in the store; `qnerf report` and `qnerf serve` show it.
"""
EXAMPLES = """\
  {} field=classical field=qcolor --within 0.5 --budget 2h
  {} field=classical field=qcolor --all "train.steps=500 threads=1"
  {} density=mlp density=amplitude density=qiren --scene "scene=nerfstudio scene.path=FOX" --scene scene=poster
  {} field=classical field=qcolor --equal time
  {} "python train.py --model a" "python train.py --model b" --metric accuracy --within 0.01
"""
CHOSEN = {
    "seed": "the study chooses the seeds, 0, 1, 2, ...; leave it out",
    "store": "the store is an option of its own, --store DIR",
    "scene.validation": "the study holds out validation views where it searches, --tune",
    "run.force": "finished runs count; `qnerf run` does one over",
}
"""Overrides that a study cannot honour, and why."""
DAY = 24.0  # hours of a study that need no --budget
UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_intermixed_args(arguments)
    if len(set(options.candidates)) < max(2, len(options.candidates)):
        raise ValueError(f"expected at least two candidates, each once, got {' '.join(options.candidates)}")
    question = Question(
        tuple(options.candidates), tuple(options.scene or [""]), " ".join(options.all),
        within_of(options.metric, options.within), options.metric, options.equal, options.tune, tuple(options.space),
    )  # fmt: skip
    check(question)
    names = [name_of(scene) for scene in question.scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"--scene: expected scenes of different names, got {', '.join(names)}")
    store = Path(options.store)
    record = Record.of(question, store)
    study(record, store, options.budget)


def check(question: Question) -> None:
    """ValueError for what the study cannot honour, and for an override that seems to be meant for all runs."""
    if question.commands:
        if odd := [text for text in question.candidates if not is_command(text.split())]:
            raise ValueError(f"{odd[0]}: expected a command, as the others are; for all it is --all {odd[0]}")
        if question.tune or question.space or question.equal == "time":
            raise ValueError(
                "--tune, --space and --equal time: expected candidates of `qnerf run`, whose options are known"
            )
        lower = metric_of(question.metric).sign < 0
        print(f"{question.metric}: {'lower' if lower else 'higher'} is better")
        return
    asked_spaces(question)
    if question.metric not in (known := [item.key for item in quality_metrics()]):
        raise ValueError(f"--metric {question.metric}: measured by no run; known: {', '.join(known)}")
    places = {"a candidate": question.candidates, "--all": [question.common], "--scene": question.scenes}
    for place, texts in places.items():
        for override in (word for text in texts for word in text.split()):
            key = override.lstrip("+~").partition("=")[0]
            if key in CHOSEN:
                raise ValueError(f"{override}: {CHOSEN[key]}")
            if place == "a candidate" and key.partition(".")[0] == "scene":
                raise ValueError(f"{override}: candidates share their scenes: --scene or --all {shlex.quote(override)}")
            if not key.startswith("hydra") and compose.parse(compose.translated(override)).is_sweep_override():
                raise ValueError(f"{override}: expected one value in {place}; every candidate is a text of its own")
    keys = [{word.partition("=")[0] for word in text.split()} for text in question.candidates]
    shared = {key for one, other in itertools.combinations(keys, 2) for key in one & other}
    if alone := [text for text, own in zip(question.candidates, keys, strict=True) if shared and not own & shared]:
        known = f"sets none of {', '.join(sorted(shared))}, in which the others differ"
        raise ValueError(f"{alone[0]}: {known}; for all candidates it is --all {shlex.quote(alone[0])}")


def parser() -> argparse.ArgumentParser:
    made = command.parser("decide", DESCRIPTION, EXAMPLES)
    made.add_argument(
        "candidates", nargs="+", metavar="CANDIDATE",
        help='such as field=qcolor, "color=qiren qiren.layers=2" or "python train.py --seed {seed}"',
    )  # fmt: skip
    made.add_argument(
        "--all", action="append", default=[], metavar="WORDS", help="of every run, such as train.steps=500"
    )
    made.add_argument("--scene", action="append", metavar="WORDS", help="a scene; several times for several scenes")
    made.add_argument(
        "--within", type=float, metavar="DELTA",
        help="smallest difference that matters, in the metric's unit; default: 0.5 dB of PSNR",
    )  # fmt: skip
    made.add_argument("--metric", default="psnr", help="default: %(default)s")
    made.add_argument(
        "--budget", type=duration, default="2h", metavar="TIME",
        help="of all trainings together, such as 90m, the search and six seeds of each at least; default: %(default)s",
    )  # fmt: skip
    made.add_argument(
        "--equal", choices=("steps", "time"), default="steps",
        help="time: the cheaper candidate trains as many more steps as the same CPU seconds allow",
    )  # fmt: skip
    made.add_argument(
        "--tune", type=int, default=0, metavar="N",
        help="search each candidate before, N trials on validation views and on seeds that judge nothing",
    )  # fmt: skip
    made.add_argument(
        "--space", action="append", default=[], metavar="OPTION=VALUES",
        help="other values of a searched option, as those of a search",
    )  # fmt: skip
    made.add_argument("--store", default=DEFAULT, metavar="DIR", help="folder of runs (default: %(default)s)")
    return made


def duration(text: str) -> float:
    """Seconds of `90s`, `30m`, `2h` or `1d`."""
    found = re.fullmatch(r"(\d{1,6}(?:\.\d{1,3})?)([smhd])", text)
    if found is None or not float(found[1]):
        raise argparse.ArgumentTypeError(f"expected a time such as 90s, 30m, 2h or 1d, got {text!r:.40}")
    return float(found[1]) * UNITS[found[2]]


def study(record: Record, store: Path, budget: float) -> None:
    """Trains and looks until everything is decided or the last look, which `budget` seconds of training pay for."""
    question, foresee, called = record.question, foreseer(record, budget), names_of(record.question.candidates)
    if question.tune and not record.spaces:
        record.spaces = {title(at, name): own for at in question.scenes for name, own in spaces(record, at).items()}
    record.register(budget, store)
    said: list[str] = []
    for scene in question.scenes if question.tune and not record.looks else ():
        measure(record, scene, store, foresee)
        tune(record, scene, store, foresee)
        if question.equal == "time":  # a chosen option may cost more
            record.steps = {
                name: steps for name, steps in record.steps.items() if not name.startswith(title(scene, ""))
            }
    for scene, name in question.pairs if question.commands and not record.looks else ():
        runs_of(record, scene, name, [0, 1], store, foresee)  # shows at once what is wrong with a program
    after_trials = f", after {question.tune} trials each" if question.tune else ""
    for scene in question.scenes:
        measure(record, scene, store, foresee)
    while scenes := [scene for scene in question.scenes if len(record.open(scene)) > 1]:
        before = max((look["seeds"] for look in record.looks), default=0)
        count = next(n for n in looks(record.most or FIRST) if n > before)
        frames = {
            scene: {name: runs_of(record, scene, name, range(count), store, foresee) for name in record.open(scene)}
            for scene in scenes
        }
        cost = {(scene, name): run["train_s"].median() for scene in scenes for name, run in frames[scene].items()}
        if not record.most:
            spent = sum(one["seconds"] for one in record.tuned.values())
            record.most = most(budget - spent, sum(cost.values()))
            record.save(store)  # another process may have fixed it meanwhile
        alpha = shares(record.most)[count] / question.comparisons
        for scene in scenes:
            values = {name: runs[question.metric] for name, runs in frames[scene].items()}
            for look in judged(question, values, alpha, last=count == record.most):
                look["verdict"] += after_trials
                record.looks.append({"scene": name_of(scene), "seeds": count, "spent": alpha, **look})
                said.append(line(record.looks[-1], called))
                print(said[-1])
        record.save(store)
        going = [(scene, name) for scene in scenes if len(names := record.open(scene)) > 1 for name in names]
        if going:
            after = min(n for n in looks(record.most) if n > count)
            minutes = (after - count) * sum(map(cost.__getitem__, going)) / 60
            print(f"next look at {after} seeds, about {minutes:.0f} minutes of training more")
    if (found := [line(look, called) for look in record.looks if look["ended"]]) != said:  # of several looks
        print("", *found, sep="\n")


def most(budget: float, cost: float) -> int:
    """Seeds a side at the last look, where one seed of everything takes `cost` seconds."""
    return int(min(MOST, max(FIRST, budget // cost)))


def foreseer(record: Record, budget: float) -> Callable[[float], None]:
    """What hears how many seconds a run takes. It says once what the whole study takes if all runs take as long.

    ValueError where that is more than the budget, and than a day.
    """
    said = bool(record.most)

    def foresee(seconds: float) -> None:
        nonlocal said
        if said or not seconds > 0:
            return
        said = True
        cost, trials = seconds * len(record.question.pairs), record.question.tune
        search = cost * (trials + len(TUNING[1:]) * min(AGAIN, trials))
        seeds = most(budget - search, cost)
        what = f"the whole study, up to {seeds} seeds of {len(record.question.pairs)} configurations"
        what += f" after {trials} trials of each" * bool(trials)
        hours = max(budget / 3600, DAY)
        if told := announced(what, search + seeds * cost, hours, "fewer candidates or steps take less", "--budget {}h"):
            print(told, flush=True)

    return foresee


def measure(record: Record, scene: str, store: Path, foresee: Callable[[float], None]) -> None:
    """For equal times, finds the steps of each candidate, once: from a training of its seed 0."""
    names = record.question.candidates
    if record.question.equal != "time" or title(scene, names[0]) in record.steps:
        return
    first = {name: trained(record.words(scene, name), [0], store, foresee).iloc[0] for name in names}
    dearest = max(run["step_cpu_ms"] for run in first.values())
    for name, run in first.items():
        steps = record.steps[title(scene, name)] = round(run["train.steps"] * dearest / run["step_cpu_ms"])
        print(f"{title(scene, name)}: {run['step_cpu_ms']:.1f} ms of CPU a step, so {steps:,} steps")
    record.save(store)


def runs_of(
    record: Record, scene: str, name: str, seeds: Sequence[int], store: Path, foresee: Callable[[float], None]
) -> pd.DataFrame:
    """The runs of a candidate, which may be colourless; ValueError where they lack the metric, or one run stands for
    several seeds."""
    metric = record.question.metric
    frame = trained(record.words(scene, name), seeds, store, foresee)
    foresee(frame["train_s"].median())
    ended = frame[frame["state"].eq("finished")]
    if len(ended) and metric not in (known := measured(ended)):
        raise ValueError(f"{title(scene, name)}: no {metric}; choose another --metric: {', '.join(known)}")
    record.runs[title(scene, name)] = list(map(str, frame.index))
    registered = datetime.fromisoformat(record.registered["time"]).timestamp()
    record.earlier[title(scene, name)] = int((frame["created"] < registered).sum())
    ids = [run for own in record.runs.values() for run in own]
    if twice := next((run for run in ids if ids.count(run) > 1), None):
        known = "its config lacks the seed, or what tells candidates apart"
        raise ValueError(f"{twice}: stands for several runs; {known}; mend the program, then `qnerf rm {twice}`")
    if gone := int(colorless(frame).sum()):
        print(f"{title(scene, name)}: {gone} of {len(frame)} runs are colourless: they show one colour, or nothing")
    return frame


def judged(
    question: Question, values: Mapping[str, pd.Series], alpha: float, *, last: bool
) -> Iterator[dict[str, Any]]:
    """What a look at the values of each candidate's runs finds; of several candidates the leader is the baseline.

    A race ends where no candidate is better than the leader by `within`. The first candidate, which the question is
    about, is compared with each of the others, too; the error rate is that of all pairs.
    """
    race = len(question.candidates) > 2
    sign = metric_of(question.metric).sign
    with np.errstate(invalid="ignore"):  # of a candidate whose runs diverge
        typical = {name: trimmed(np.sort((sign * own).fillna(-np.inf)), trim(own))[0] for name, own in values.items()}
    baseline = max(typical, key=typical.__getitem__) if race else question.candidates[0]
    first = question.candidates[0]
    pairs = [(baseline, name) for name in values if name != baseline]
    pairs += [(name, first) for name in values if first in values and baseline != first != name != baseline]
    found = {
        (one, two): verdict(values[one], values[two], question.within, metric=question.metric, alpha=alpha)
        for one, two in pairs
    }
    decided = {name: one.kind != "undecided" for (against, name), one in found.items() if against == baseline}
    with_leader = [found[baseline, name] for name in decided]
    over = last or (race and all(one.kind != "undecided" or one.excluded == "a gain" for one in with_leader))
    for (against, name), one in found.items():
        numbers = {"difference": one.difference, "reach": one.reach, "shown": interval(one, question.metric)}
        said = {"verdict": one.text(question.metric), "ended": over or decided[name]}
        yield {"baseline": against, "candidate": name, **numbers, **said}


def line(look: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """`4 seeds: fox: field=qcolor - field=classical: -0.20 ± 1.73 (99.9 %), undecided`; names: as of `names_of`."""
    pair = f"{title(look['scene'], names[look['candidate']])} - {names[look['baseline']]}"
    return f"{look['seeds']} seeds: {pair}: {look['shown']} ({100 * (1 - look['spent']):.4g} %), {look['verdict']}"


if __name__ == "__main__":
    command.run(main)
