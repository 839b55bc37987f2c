"""How often a verdict is wrong, and how often it decides: `python -m benchmarks.coverage`.

Takes the run means of every pair of configurations of the same scene in docs/results/seeds (ten seeds), removes the
means, and draws experiments from what is left: the seeds' own spreads, skewness and tails. One side is then shifted by
a true difference. `wrong` is a false sign or a false equivalence, `decided` is a verdict other than "undecided".
Compared are tables of 3 to 20 seeds, which look once, and `qnerf decide`, which looks several times.

Prints the table and saves it in benchmarks/results/coverage.parquet.
"""

import argparse
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
from qnerf.analysis import load
from qnerf.analysis.decide.looks import MOST, shares
from qnerf.analysis.verdict import Verdict, evaluations, verdict

RESULTS = Path(__file__).parent / "results" / "coverage.parquet"
SEEDS_PACK = Path(__file__).parents[1] / "docs" / "results" / "seeds"
CONFIGURATION = ["scene_name", "field", "density.mlp.init", "color.mlp.init", "color.directions"]
WITHIN = 0.5

Draw = Callable[[int], np.ndarray]


def pairs(store: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """The centred run means of every two configurations of a scene."""
    runs = load.runs(store, "state=finished")
    means = evaluations(runs).mean(axis=1)
    keys = [key for key in CONFIGURATION if key in runs]
    groups = [(key[0], means[own["path"]].to_numpy()) for key, own in runs.groupby(keys, dropna=False)]
    centred = [(scene, values - values.mean()) for scene, values in groups]
    return [(one[1], two[1]) for one, two in combinations(centred, 2) if one[0] == two[0]]


def single(one: Draw, two: Draw, seeds: int) -> tuple[Verdict, int]:
    return verdict(one(seeds), two(seeds), WITHIN, metric="psnr"), seeds


def several(one: Draw, two: Draw) -> tuple[Verdict, int]:
    """What `qnerf decide` finds, and after how many seeds a side."""
    values = one(MOST), two(MOST)
    for count, alpha in shares().items():
        found = verdict(values[0][:count], values[1][:count], WITHIN, alpha=alpha)
        if found.kind != "undecided":
            break
    return found, count


def rows(measured: list[tuple[np.ndarray, np.ndarray]], experiments: int) -> Iterator[dict[str, object]]:
    """A row a method and true difference in dB: shares of wrong and decided verdicts, mean number of seeds a side."""
    random = np.random.default_rng(0)
    methods: dict[str, Callable[[Draw, Draw], tuple[Verdict, int]]] = {"qnerf decide, up to 20 seeds": several}
    methods |= {f"one look, {n} seeds": (lambda one, two, n=n: single(one, two, n)) for n in (3, 5, 10, 20)}
    for name, method in methods.items():
        for true in (0.0, 0.3, WITHIN, 1.0, 2.0):
            wrong, decided, seeds = 0, 0, 0
            for number in range(experiments):
                one, two = measured[number % len(measured)]
                found, used = method(
                    lambda n, one=one: random.choice(one, n), lambda n, two=two, t=true: random.choice(two, n) + t
                )
                false_sign = found.kind == "worse" or (found.kind == "better" and true == 0)
                wrong += false_sign or (found.kind == "equivalent" and true >= WITHIN)
                decided += found.kind != "undecided"
                seeds += used
            shares = {"wrong": wrong / experiments, "decided": decided / experiments, "seeds": seeds / experiments}
            yield {"method": name, "true": true, "experiments": experiments} | shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, default=SEEDS_PACK, help="runs with many seeds; default: %(default)s")
    parser.add_argument("--experiments", type=int, default=2000, help="for each row; default: %(default)s")
    options = parser.parse_args()
    table = pd.DataFrame(rows(pairs(options.store), options.experiments))
    table.to_parquet(RESULTS, index=False)
    shown = table.pivot(index="method", columns="true", values=["wrong", "decided", "seeds"])
    print(shown.to_string(float_format="{:.3f}".format))


if __name__ == "__main__":
    main()
