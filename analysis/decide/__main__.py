"""`qnerf decide A B`: see `--help`."""

import argparse
import re
import time
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from qnerf.cli.numbers import number
from qnerf.metrics import metric_of
from qnerf.records.location import DEFAULT

from .. import command
from ..tables.differences import interval
from ..verdict import within_of
from .looks import FIRST, affordable, look, looks, planned, race, shares
from .study import Question, Record, known, results, train

DESCRIPTION = """\
Trains seeds of each candidate until it is decided which is better, or that they are equivalent, or until the end of
the budget. A candidate is a text of overrides, as of `qnerf run`; the first is the baseline. Finished runs of the store
count, and the same command goes on with what was stopped. No more than 5 % of such studies end in a wrong verdict,
over all looks. The record stays in the store; `qnerf report` and `qnerf serve` show it.
"""
EXAMPLES = """\
  {} field=classical field=qcolor --within 0.5 --budget 2h
  {} field=classical field=qcolor --all "train.steps=500 hydra/launcher=joblib"
  {} density=mlp density=amplitude density=qiren --scene "scene=nerfstudio scene.path=FOX" --scene scene=room
  {} field=classical field=qcolor --equal time
  {} field=classical field=qcolor --plan
"""
UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400}


def main(arguments: Sequence[str] | None = None) -> None:
    options = parser().parse_args(arguments)
    if len(options.candidates) < 2:
        raise ValueError(f"expected at least two candidates, got {' '.join(options.candidates)}")
    question = Question(
        tuple(options.candidates), tuple(options.scene or [""]), options.all, within_of(options.metric, options.within),
        options.metric, options.equal,
    )  # fmt: skip
    names = [_scene(scene) for scene in question.scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"--scene: expected scenes of different names, got {', '.join(names)}")
    store = Path(options.store)
    if options.plan:
        plan(question, store)
        return
    record = Record.of(question, store)
    try:
        Study(question, record, store, options.budget).run()
    except KeyboardInterrupt:
        print("stopped; the same command goes on")
        raise


def parser() -> argparse.ArgumentParser:
    made = command.parser("decide", DESCRIPTION, EXAMPLES)
    made.add_argument("candidates", nargs="+", metavar="OVERRIDES", help='such as field=qcolor or "color=qiren seed=3"')
    made.add_argument("--all", default="", metavar="OVERRIDES", help="of every run, such as train.steps=500")
    made.add_argument("--scene", action="append", metavar="OVERRIDES", help="a scene; several times for several scenes")
    made.add_argument(
        "--within", type=number(0, 1e9, above=True), metavar="DELTA",
        help="smallest difference that matters, in the metric's unit; default: 0.5 dB of PSNR",
    )  # fmt: skip
    made.add_argument("--metric", default="psnr", help="default: %(default)s")
    made.add_argument("--budget", type=duration, default="2h", metavar="TIME", help="such as 90m; default: %(default)s")
    made.add_argument(
        "--equal", choices=("steps", "time"), default="steps",
        help="time: the cheaper candidate trains as many more steps as the same CPU seconds allow",
    )  # fmt: skip
    made.add_argument("--plan", action="store_true", help="instead: how many seeds and hours it may take")
    made.add_argument("--store", default=DEFAULT, metavar="DIR", help="folder of runs (default: %(default)s)")
    return made


def duration(text: str) -> float:
    """Seconds of `90s`, `30m`, `2h` or `1d`."""
    found = re.fullmatch(r"(\d{1,6}(?:\.\d{1,3})?)([smhd])", text)
    if found is None or not float(found[1]):
        raise argparse.ArgumentTypeError(f"expected a time such as 90s, 30m, 2h or 1d, got {text!r:.40}")
    return float(found[1]) * UNITS[found[2]]


def plan(question: Question, store: Path) -> None:
    """Prints the range of seeds and hours that each comparison may take, from its finished runs."""
    unit = metric_of(question.metric).unit
    for scene in question.scenes:
        done = {name: known(store, question.overrides(scene, name), FIRST) for name in question.candidates}
        few = [name for name, count in done.items() if count < 2]
        if few:
            raise ValueError(f"{few[0]}: a plan needs at least 2 finished runs: `qnerf run -m {few[0]} seed=0,1,2,3`")
        frames = {name: results(store, question.overrides(scene, name), range(count)) for name, count in done.items()}
        baseline, *others = question.candidates
        for other in others:
            one, two = (frames[name][question.metric].dropna() for name in (baseline, other))
            cost = sum(_cost(frames[name]) for name in (baseline, other))
            for difference in (0.0, 2 * question.within):
                low, high = planned(one, two, question.within, difference)
                case = f"if they differ by {difference:g} {unit}".rstrip() if difference else "if they are equal"
                hours = f"{low * cost / 3600:.1f} to {high * cost / 3600:.1f} hours"
                print(f"{_title(scene, other)} - {baseline}, {case}: {low} to {high} seeds each, {hours}")


class Study:
    """Trains and looks until everything is decided, the last look or the end of the budget in seconds."""

    def __init__(self, question: Question, record: Record, store: Path, budget: float) -> None:
        self.question, self.record, self.store, self.budget = question, record, store, budget
        self.started = time.monotonic()

    def run(self) -> None:
        record, question = self.record, self.question
        begun = {look["seeds"] for look in record.looks}
        while open_scenes := [scene for scene in question.scenes if not self._is_done(scene)]:
            count = next((n for n in looks(record.most or FIRST) if n not in begun), None)
            if count is None:
                break
            if record.looks and time.monotonic() - self.started > self.budget:
                print(f"the budget has ended; the same command goes on to {count} seeds")
                return
            frames = {scene: self._trained(scene, count) for scene in open_scenes}
            if not record.most:
                record.cost_s = sum(_cost(frame) for own in frames.values() for frame in own.values())
                record.most = affordable(self.budget, record.cost_s)
            alpha = shares(record.most)[looks(record.most).index(count)] / len(question.scenes)
            for scene, own in frames.items():
                self._look(scene, own, count, alpha)
            begun.add(count)
            record.save(self.store)
            self._say_what_next(count)
        for name, text in record.verdicts.items():
            print(f"{name}: {text}")

    def _is_done(self, scene: str) -> bool:
        names = [_title(scene, name) for name in self.question.candidates]
        decided = [name in self.record.verdicts for name in names]
        return all(decided[1:]) if len(names) == 2 else sum(decided) == len(names)

    def _trained(self, scene: str, count: int) -> dict[str, pd.DataFrame]:
        """The runs of every candidate that is still in question."""
        kept = [name for name in self.question.candidates if _title(scene, name) not in self.record.verdicts]
        kept = list(self.question.candidates) if len(self.question.candidates) == 2 else kept
        if self.question.equal == "time" and _title(scene, kept[0]) not in self.record.steps:
            self._equalise(scene, kept)
        frames = {}
        for name in kept:
            overrides = self.question.overrides(scene, name, self.record.steps.get(_title(scene, name)))
            train([*overrides, f"store={self.store}"], range(count))
            frames[name] = results(self.store, overrides, range(count))
        return frames

    def _equalise(self, scene: str, names: Sequence[str]) -> None:
        """Measures a step of each candidate and gives the cheaper ones more of them."""
        first = {}
        for name in names:
            overrides = self.question.overrides(scene, name)
            train([*overrides, f"store={self.store}"], [0])
            first[name] = results(self.store, overrides, [0]).iloc[0]
        dearest = max(run["step_cpu_ms"] for run in first.values())
        for name, run in first.items():
            steps = round(run["train.steps"] * dearest / run["step_cpu_ms"])
            self.record.steps[_title(scene, name)] = steps
            print(f"{_title(scene, name)}: {run['step_cpu_ms']:.1f} ms of CPU a step, so {steps:,} steps")
        self.record.save(self.store)  # the ratio is measured once: measured again, it would ask for other runs

    def _look(self, scene: str, frames: dict[str, pd.DataFrame], count: int, alpha: float) -> None:
        question, record = self.question, self.record
        values = {name: frame[question.metric].to_numpy(dtype=float) for name, frame in frames.items()}
        last = count >= record.most
        if len(question.candidates) > 2:
            best, worse, close = race(values, question.within, alpha, metric_of(question.metric).sign)
            record.verdicts |= {_title(scene, name): f"worse than {best}" for name in worse}
            rest = [name for name in values if name not in (*worse, best)]
            if close or not rest or last:
                said = f"within {question.within:g} of {best}" if close else f"undecided against {best}"
                record.verdicts |= {_title(scene, name): said for name in rest} | {_title(scene, best): "the best"}
            print(f"{count} seeds: {_title(scene, best)} leads, out: {', '.join(worse) or 'nobody'}")
            record.looks.append(
                {"name": _title(scene, best), "seeds": count, "spent": alpha, "leader": best, "worse": worse}
            )
            return
        baseline, other = question.candidates
        name = _title(scene, other)
        found, collapse = look(values[baseline], values[other], question.within, alpha, question.metric)
        entry = {"difference": found.difference, "reach": found.reach, "verdict": found.kind, "collapse_p": collapse}
        record.looks.append({"name": name, "seeds": count, "spent": alpha, **entry, "collapsed": list(found.collapsed)})
        level = f"{100 * (1 - alpha):.4g} %"
        text = found.text(question.metric)
        if collapse < alpha:
            text += "; they do not collapse equally often"
        print(f"\n{count} seeds: {name} - {baseline}: {interval(found, question.metric)} ({level}), {text}")
        if found.kind != "undecided" or collapse < alpha or last:
            record.verdicts[name] = f"{text} ({interval(found, question.metric)}, {count} seeds)"

    def _say_what_next(self, count: int) -> None:
        record = self.record
        left = [n for n in looks(record.most) if n > count]
        if left and any(not self._is_done(scene) for scene in self.question.scenes):
            print(f"next look at {left[0]} seeds, about {(left[0] - count) * record.cost_s / 60:.0f} minutes more")


def _cost(frame: pd.DataFrame) -> float:
    """Median seconds of a run: training and evaluation."""
    return float((frame["train_s"] + frame.get("eval_s", pd.Series(0.0, frame.index)).fillna(0)).median())


def _title(scene: str, candidate: str) -> str:
    return f"{_scene(scene)}: {candidate}" if scene else candidate


def _scene(overrides: str) -> str:
    """The name of a scene: its folder's or, without one, its kind."""
    values = dict(part.partition("=")[::2] for part in overrides.split())
    return Path(values.get("scene.path") or values.get("scene", overrides)).name


if __name__ == "__main__":
    command.run(main)
