"""How often a verdict is wrong, and how often it decides: `python -m benchmarks.coverage`.

Takes the run means of every pair of configurations of the same scene in docs/results/seeds (ten seeds), and draws
experiments from them: the seeds' own spreads, skewness and tails. A tenth of one side's runs may be lower by 3 dB (it
slips) or by 6 dB (it collapses). The typical runs, trimmed means of what is drawn from, differ by a true difference.
`wrong` is a false sign or a false equivalence, `decided` is a verdict other than "undecided". Compared are tables of 3
to 20 seeds, which look once, and `qnerf decide`, which looks several times. In a race, three candidates that are alike
differ from the first one; `wrong` is then any wrong verdict on two of the four, `decided` one on the first with each.

`luck` is the standard deviation of a validation score around the quality of a trial, in dB, where each side was
searched first: 12 trials whose qualities have a standard deviation of 0.3 dB, the best three scored twice more. `wrong`
is then about the two configurations that were chosen, `wrong_heads` about heads that are alike in what a search can
find.

Prints the table and saves it in benchmarks/results/coverage.parquet.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from qnerf.analysis import load
from qnerf.analysis.decide.__main__ import judged
from qnerf.analysis.decide.looks import MOST, shares
from qnerf.analysis.decide.study import Question
from qnerf.analysis.verdict import TRIM, evaluations, trimmed, verdict

RESULTS = Path(__file__).parent / "results" / "coverage.parquet"
SEEDS_PACK = Path(__file__).parents[1] / "docs" / "results" / "seeds"
CONFIGURATION = ["scene_name", "field", "density.mlp.init", "color.mlp.init", "color.directions"]
WITHIN = 0.5
DROPS = {"as measured": 0.0, "a tenth of one side slips": 3.0, "a tenth of one side collapses": 6.0}
"""Kind of runs -> by how many dB a tenth of one side is lower."""
TRIALS, QUALITY = 12, 0.3

RACERS = Question(("first", "second", "third", "fourth"), ("",), "", WITHIN)

Draw = Callable[[int], np.ndarray]
Found = Mapping[tuple[str, str], str]
"""Two candidates, of two the first and "second" -> the last verdict on them, as `Verdict.kind` has it."""


def pairs(store: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """The run means of every two configurations of a scene."""
    runs = load.runs(store, "state=finished")
    means = evaluations(runs).mean(axis=1)
    keys = [key for key in CONFIGURATION if key in runs]
    groups = [(key[0], means[own["path"]].to_numpy()) for key, own in runs.groupby(keys, dropna=False)]
    return [(one[1], two[1]) for one, two in combinations(groups, 2) if one[0] == two[0]]


def population(values: np.ndarray, drop: float) -> np.ndarray:
    """What runs are drawn from: the values, of which a tenth is lower by `drop` dB; their trimmed mean is 0."""
    found = np.sort(np.r_[np.tile(values, 9), values - drop])
    return found - trimmed(np.sort(found), TRIM)[0]


def searched(random: np.random.Generator, luck: float) -> float:
    """The quality of the trial that a search of `TRIALS` chooses, dB."""
    quality = random.normal(0, QUALITY, TRIALS)
    best = np.argsort(quality + random.normal(0, luck, TRIALS))[-3:]
    return float(quality[best][np.argmax(quality[best] + random.normal(0, luck / 2**0.5, 3))])


def single(one: Draw, two: Draw, seeds: int) -> tuple[Found, int]:
    return {("first", "second"): verdict(one(seeds), two(seeds), WITHIN, metric="psnr").kind}, seeds


def several(one: Draw, two: Draw, most: int = MOST) -> tuple[Found, int]:
    """What `qnerf decide` finds, whose budget pays for `most` seeds a side, and after how many."""
    values = one(most), two(most)
    for count, alpha in shares(most).items():
        found = verdict(values[0][:count], values[1][:count], WITHIN, alpha=alpha)
        if found.kind != "undecided":
            break
    return {("first", "second"): found.kind}, count


def race(one: Draw, two: Draw, most: int = MOST) -> tuple[Found, int]:
    """The same of four candidates, of which all but the first are drawn by `two`."""
    first, *others = RACERS.candidates
    values = {first: one(most)} | {name: two(most) for name in others}
    found = {}
    for count, alpha in shares(most).items():
        seen = {name: pd.Series(own[:count]) for name, own in values.items()}
        for look in judged(RACERS, seen, alpha / RACERS.comparisons, last=count == most):
            found[look["baseline"], look["candidate"]] = look["verdict"].split()[0].strip(":;")
            if look["ended"]:
                values.pop(look["candidate"], None)
        if len(values) < 2:
            break
    return found, count


def rows(measured: list[tuple[np.ndarray, np.ndarray]], experiments: int) -> Iterator[dict[str, object]]:
    """A row a method, kind of runs, luck and true difference in dB: shares of wrong and decided verdicts, mean
    number of seeds a side."""
    random = np.random.default_rng(0)
    decide = "qnerf decide, up to 20 seeds"
    raced = "qnerf decide, a race of four"
    methods: dict[str, Callable[[Draw, Draw], tuple[Found, int]]] = {decide: several, raced: race}
    short = {n: f"qnerf decide, up to {n} seeds" for n in (6, 9)}
    methods |= {name: lambda one, two, n=n: several(one, two, n) for n, name in short.items()}
    methods |= {f"one look, {n} seeds": (lambda one, two, n=n: single(one, two, n)) for n in (3, 5, 10, 20)}
    asked = [(name, "as measured", None, true) for name in methods for true in (0.0, 0.3, WITHIN, 1.0, 2.0)]
    dropped = ("one look, 10 seeds", raced, *short.values())
    asked += [(name, runs, None, true) for name in dropped for runs in DROPS for true in (0.0, WITHIN, -WITHIN)]
    asked += [
        (decide, runs, luck, true)
        for runs in DROPS
        for luck in (None, 0.0, 0.3, 1.0)
        for true in (0.0, WITHIN, -WITHIN)
    ]
    for name, runs, luck, true in dict.fromkeys(asked):
        counts = np.zeros(4)
        populations = [(population(one, 0.0), population(two, DROPS[runs])) for one, two in measured]
        for number in range(experiments):
            one, two = populations[number % len(measured)]
            actual = true if luck is None else true + searched(random, luck) - searched(random, luck)
            found, used = methods[name](
                lambda n, one=one: random.choice(one, n), lambda n, two=two, shift=actual: random.choice(two, n) + shift
            )
            decided = all(kind != "undecided" for names, kind in found.items() if "first" in names)
            counts += wrong(found, actual), wrong(found, true), decided, used
        shares = dict(zip(("wrong", "wrong_heads", "decided", "seeds"), counts / experiments, strict=True))
        yield {"method": name, "runs": runs, "luck": luck, "true": true, "experiments": experiments} | shares


def wrong(found: Found, true: float) -> bool:
    """Whether a verdict contradicts that all others are better than the first candidate by a true difference."""
    for names, kind in found.items():
        actual = true * ((names[1] != "first") - (names[0] != "first"))
        if {"better": actual <= 0, "worse": actual >= 0, "equivalent": abs(actual) >= WITHIN}.get(kind, False):
            return True
    return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, default=SEEDS_PACK, help="runs with many seeds; default: %(default)s")
    parser.add_argument("--experiments", type=int, default=2000, help="for each row; default: %(default)s")
    options = parser.parse_args()
    table = pd.DataFrame(rows(pairs(options.store), options.experiments))
    table.to_parquet(RESULTS, index=False)
    values = ["wrong", "wrong_heads", "decided", "seeds"]
    shown = table.fillna({"luck": -1}).pivot(index=["method", "runs", "luck"], columns="true", values=values)
    print(shown.to_string(float_format="{:.3f}".format))


if __name__ == "__main__":
    main()
