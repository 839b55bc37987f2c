"""How good is a search with the compute of 15 runs, beside a grid of 40? `python -m benchmarks.search [--grid STORE]`.

The runs of the grid are trained once per scene:

    python -m src.run -m field=qcolor train.steps=600 train.eval_every=100 store=STORE \\
      qiren.layers=1,2 qiren.gain=1,3,10,30 train.lr=3e-3,1e-2,3e-2,6e-2,1e-1

With `--grid` they are read from STORE and kept in benchmarks/results/search_grid.parquet. Then searches of the grid are
replayed with other seeds of the sampler: each trial writes what its run of the grid measured, and is given up where a
search would give it up. Prints how far below the grid's best run a search ends, and saves it as
benchmarks/results/search.parquet. Random choices, with and without giving up, are the control.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from qnerf.analysis import load

from qnerf.records import RunStore
from qnerf.search.history import History
from qnerf.search.loop import Options, search
from qnerf.search.pruning import Judge
from qnerf.search.space import Choices, Point, Space
from qnerf.search.study import Trial
from qnerf.training.stopping import PRUNED

RESULTS = Path(__file__).parent / "results"
KEYS = ["qiren.layers", "qiren.gain", "train.lr"]
COMPUTE = 15  # runs
SEARCHES = {
    "tpe, giving up": ("tpe", 50.0),
    "tpe, to the end": ("tpe", 0.0),
    "gp, giving up": ("gp", 50.0),
    "random, giving up": ("random", 50.0),
    "random, to the end": ("random", 0.0),
}
"""Name -> sampler, percentile of `hydra.sweeper.prune`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grid", metavar="STORE", help="store of the trained grid")
    parser.add_argument("--seeds", type=int, default=20)
    options = parser.parse_args()
    kept = RESULTS / "search_grid.parquet"
    if options.grid:
        read(options.grid).to_parquet(kept, index=False)
    grid = pd.read_parquet(kept)
    rows = []
    for scene, runs in grid.groupby("scene_name"):
        best = runs["psnr"].max()
        for name, (sampler, percentile) in SEARCHES.items():
            found = [replay(runs, sampler, percentile, seed) for seed in range(options.seeds)]
            short = pd.Series([best - psnr for psnr, _ in found])
            rows.append(
                {
                    "scene": scene,
                    "search": name,
                    "grid": runs.groupby(KEYS).ngroups,
                    "trials": float(pd.Series([trials for _, trials in found]).mean()),
                    "median below the best, dB": short.median(),
                    "worst, dB": short.max(),
                    "within 0.1 dB, %": 100 * (short <= 0.1).mean(),
                }
            )
    table = pd.DataFrame(rows)
    table.to_parquet(RESULTS / "search.parquet", index=False)
    print(table.to_string(index=False, float_format=lambda value: f"{value:.2f}"))


def read(store: str) -> pd.DataFrame:
    """A row for each evaluation of each run: scene, settings, step, `curve` (PSNR then), `psnr` (at the end)."""
    runs = load.completed(load.runs(store))
    curves = load.metrics(runs, "eval/psnr")[["run_id", "step", "value"]].rename(columns={"value": "curve"})
    return curves.merge(runs[["run_id", "scene_name", "psnr", *KEYS]], on="run_id").drop(columns="run_id")


def replay(grid: pd.DataFrame, sampler: str, percentile: float, seed: int) -> tuple[float, int]:
    """A search over the grid of one scene until it has used the compute: its best PSNR (dB) and its trials."""
    values = {key: sorted(grid[key].unique().tolist()) for key in KEYS}
    space: Space = {key: Choices(tuple(map(str, own)), tuple(own)) for key, own in values.items()}
    trained = {
        tuple(map(str, point)): runs.sort_values("step")  # type: ignore[arg-type]
        for point, runs in grid.groupby(KEYS)
    }
    full = int(grid["step"].max())
    used = 0

    with tempfile.TemporaryDirectory() as folder:
        store = RunStore(folder)

        def launch(points: Sequence[Point], trials: Sequence[Trial]) -> None:
            nonlocal used
            (point,) = points
            peers = [name for trial in trials if trial.state == "finished" for name in trial.runs]
            judge = Judge(store.root, ["psnr"], peers, percentile) if percentile else None
            layers, gain, rate = point
            config = {"qiren": {"layers": int(layers), "gain": int(gain)}, "train": {"lr": float(rate)}, "seed": 0}
            run = store.claim(name(point), config).run
            assert run is not None
            for step, value in trained[point][["step", "curve"]].itertuples(index=False):
                run.log(step, 0.0, {"eval/psnr": value})
                run.flush()
                if step < full and judge and judge(run.dir, step, {"psnr": value}):
                    used += step
                    run.write_summary({"stopped": PRUNED})
                    run.interrupt()
                    return
            used += full
            run.finish({"psnr": float(trained[point]["psnr"].iloc[0])})

        def name(point: Point) -> str:
            return "-".join(point)

        history = History(space, ["psnr"], store.root, lambda point: [name(point)], {})
        plan = Options(len(trained), sampler=sampler, seed=seed)
        trials = search(history, plan, launch, lambda: used > (COMPUTE - 1) * full)
    return max(trial.values[0] for trial in trials if trial.state == "finished"), len(trials)


if __name__ == "__main__":
    main()
